"""The sensor's own effects as findings, beside those that are fitted: spikes, a coarse grid, jittered sampling."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.advice import remedy
from autotuner.core.diagnosis.coarse_sensor import fitted_to_intervals, outside
from autotuner.core.diagnosis.effect import Place
from autotuner.core.diagnosis.result import FoundEffect, Misfit
from autotuner.core.diagnosis.sensor import COARSE, HARMFUL, JITTER_GAIN, jitter_of
from autotuner.core.identification.linear import solve_linear
from autotuner.core.signals.noise import SIGNIFICANT, autocorrelation

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.base import Base
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.diagnosis.sensor import Grid, SensorRecord
    from autotuner.core.diagnosis.trace import Trace

CERTAIN = 0.98
GRADUALLY = (0.3, 0.3, 0.1, 0.1, 0.03, 0.03, 0.01, 0.003)
"""Noise, in misfits, of the rounds of a fit whose weights follow from it."""
SHARES = (1.0, 0.4, 0.1, 0.0)
"""Shares of a step that are tried."""
STOOD_STILL = "the reading stood still while the PV moved: check the sensor, its converter and the communication"
IN_RUNS, FORGOTTEN = 8, 0.25
"""Samples in a row that may be late together, and the autocorrelation after them: a process lacks it longer."""
MORE_THAN_NOISE = 1.25
"""Misfit over noise at rest from which sampling times are looked at."""
ONE_INTERVAL = 1.2
"""Widest spread of the moves' latenesses that sampling makes, in sample intervals."""
LARGE_MOVE = 0.3
"""Share of the largest move from which a move's time counts."""
WITH_SLOPE, MOSTLY = 0.2, 0.55
"""Correlation of the sizes of residual and slope, and share of the residual, from which sampling times make it."""
HARDLY = 0.12
"""Distance outside of what the readings allow, in steps, up to which nothing else is looked for."""
BETWEEN = 0.3
"""Distance outside of the grid's allowance, in steps, up to which the grid explains the record."""


@dataclass(frozen=True, slots=True)
class SensorFinding:
    """An effect of the sensor, with the errors that it accounts for."""

    effect: FoundEffect
    misfits: dict[str, Misfit]


def sensor_findings(bench: Bench, found: Trace, sensor: SensorRecord, first: Base) -> tuple[list[SensorFinding], Trace]:
    """Return the sensor's effects, and the trace as they leave it."""
    findings = []
    spikes = _spikes(bench, found, sensor, first)
    if spikes is not None:
        findings.append(spikes)
    elif sensor.frozen.any() and not _was_at_rest(bench, found, sensor):
        findings.append(_frozen(bench, found, sensor))
    if sensor.grid is not None:
        coarse, found = _coarse(bench, found, sensor)
        if coarse is not None:
            findings.append(coarse)
    elif not set(found.chosen.names) - {"timing_jitter"} and (jitter := jitter_seen(bench, found.chosen)) is not None:
        tau, rest = jitter
        finding = _named("timing_jitter", {"spread_s": tau * math.sqrt(12.0)}, {})
        findings.append(SensorFinding(finding, _scaled(bench, found, tau, rest)))
    return findings, found


def explained_by_grid(bench: Bench, candidate: Fitted, grid: Grid) -> bool:
    """Return whether a process fitted to what a coarse sensor allows leaves next to nothing outside of that."""
    if bench.case.grid_noise < max(bench.case.floor, bench.case.noise / 2.0):
        return False
    refined = fitted_to_intervals(bench, candidate, grid)
    return all(_rms(outside(bench, refined, grid, rows)) < HARDLY * grid.step for rows in (bench.fine, bench.held_out))


def _named(name: str, sizes: dict[str, float], intervals: dict[str, tuple[float, float]]) -> FoundEffect:
    return FoundEffect(name, Place.SENSOR.value, sizes, intervals, CERTAIN, advice=remedy(name, sizes))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _spikes(bench: Bench, found: Trace, sensor: SensorRecord, first: Base) -> SensorFinding | None:
    """Return the spikes when they are more than the noise's own tail."""
    case = bench.case
    rows = np.flatnonzero(sensor.spikes)
    if rows.size < 2:
        return None
    off = case.data.pv[rows] - found.chosen.simulated(rows)
    if float(off @ off) < HARMFUL * case.data.t.size * max(found.noise, found.chosen.rms) ** 2:
        return None
    early = case.data.t <= case.fitted_until_s
    misfits = {}
    for name, part, kept in (("fitted", early, bench.fine), ("held_out", ~early, bench.held_out)):
        whole = np.flatnonzero(part)
        before = _rms(case.data.pv[whole] - first.best.simulated(whole))
        misfits[name] = Misfit(before, _rms(case.data.pv[kept] - found.chosen.simulated(kept)), found.noise)
    sizes = {"samples": float(rows.size), "typical_size": float(np.median(np.abs(off)))}
    return SensorFinding(_named("outliers", sizes, {}), misfits)


def _was_at_rest(bench: Bench, found: Trace, sensor: SensorRecord) -> bool:
    """Return whether the model stands where the reading stood: then it was the process."""
    rows = np.flatnonzero(sensor.frozen)
    off = bench.case.data.pv[rows] - found.chosen.simulated(rows)
    return _rms(off) < MORE_THAN_NOISE * math.hypot(found.noise, bench.case.floor)


def _frozen(bench: Bench, found: Trace, sensor: SensorRecord) -> SensorFinding:
    """Return readings that stood still while the PV moved: outliers of a kind of their own."""
    case = bench.case
    rows = np.flatnonzero(sensor.frozen)
    off = np.abs(case.data.pv[rows] - found.chosen.simulated(rows))
    early = case.data.t <= case.fitted_until_s
    misfits = {}
    for name, part, kept in (("fitted", early, bench.fine), ("held_out", ~early, bench.held_out)):
        whole = np.flatnonzero(part)
        before = _rms(case.data.pv[whole] - found.alone.simulated(whole))
        misfits[name] = Misfit(before, _rms(case.data.pv[kept] - found.chosen.simulated(kept)), found.noise)
    sizes = {"samples": float(rows.size), "typical_size": float(np.median(off))}
    named = replace(_named("outliers", sizes, {}), form="frozen", advice=STOOD_STILL)
    return SensorFinding(named, misfits)


def _coarse(bench: Bench, found: Trace, sensor: SensorRecord) -> tuple[SensorFinding | None, Trace]:
    """Return the grid when it is coarser than the other noise, and the model fitted to what the readings allow."""
    grid = sensor.grid
    assert grid is not None  # noqa: S101 - asked before
    case = bench.case
    plain = replace(found, chosen=found.chosen)
    refined = fitted_to_intervals(bench, found.chosen, grid)
    parts = {"fitted": bench.fine, "held_out": bench.held_out}
    left = {name: _rms(outside(bench, refined, grid, rows)) for name, rows in parts.items()}
    if left["fitted"] > COARSE * case.grid_noise or case.grid_noise < case.floor:
        return None, plain
    if left["fitted"] > BETWEEN * grid.step and not found.chosen.problem.effects:
        return None, plain
    noise = max(left["fitted"], case.floor)
    misfits = {
        name: Misfit(_rms(case.data.pv[rows] - found.alone.simulated(rows)), left[name], noise)
        for name, rows in parts.items()
    }
    sizes = {"step": grid.step}
    finding = SensorFinding(
        _named("sensor_quantisation", sizes, {"step": (0.98 * grid.step, 1.02 * grid.step)}), misfits
    )
    return finding, replace(found, chosen=refined, noise=noise)


def jitter_seen(bench: Bench, chosen: Fitted) -> tuple[float, float] | None:
    """Return the spread of the sampling times, s, and the noise at rest, PV, when a residual shows jittered sampling.

    It grows with the slope of the PV, and is white or lasts for a few samples only.
    """
    case = bench.case
    rows = chosen.problem.rows
    resting = rows < case.at_rest
    rest = max(float(np.std(chosen.residual[resting])) if resting.any() else case.noise, case.floor)
    if chosen.rms < MORE_THAN_NOISE * rest:
        return None
    chosen, tau, gain = _by_slope(bench, chosen, rest)
    slope = _slope(bench, chosen)
    lasting = autocorrelation(chosen.residual / np.sqrt(rest**2 + (tau * slope) ** 2))[IN_RUNS:]
    short = np.abs(lasting).max(initial=0.0) < max(FORGOTTEN, SIGNIFICANT / math.sqrt(rows.size))
    with_slope = float(np.corrcoef(np.abs(chosen.residual), np.abs(slope))[0, 1])
    # Latenesses of the moves take up a part of what shows the likelihood; then the slope has to.
    likely = with_slope > WITH_SLOPE if chosen.problem.effects else gain > JITTER_GAIN
    seen = likely and tau * _rms(slope) > MOSTLY * chosen.rms and tau < case.data.interval_s
    return (tau, rest) if short and seen else None


def _slope(bench: Bench, chosen: Fitted) -> FloatArray:
    t = bench.case.data.t
    result: FloatArray = np.gradient(chosen.simulated(np.arange(t.size)), t)[chosen.problem.rows]
    return result


def _by_slope(bench: Bench, chosen: Fitted, rest: float) -> tuple[Fitted, float, float]:
    """Return a model fitted with weights `1/sqrt(rest^2 + (tau slope)^2)`, with `tau` and its gain in likelihood.

    Without them it follows what the sampling times make of steep parts, and misses the flat ones, which tell more.
    These come in by and by: the noise begins at a part of the misfit.
    """
    tau, gain = jitter_of(chosen.residual, _slope(bench, chosen), rest)
    for part in GRADUALLY:
        weight = 1.0 / np.sqrt(max(rest, part * chosen.rms) ** 2 + (tau * _slope(bench, chosen)) ** 2)
        chosen = _weighted_step(chosen, weight)
        tau, gain = jitter_of(chosen.residual, _slope(bench, chosen), rest)
    return chosen, tau, gain


def _weighted_step(chosen: Fitted, weight: FloatArray) -> Fitted:
    """Return the model after a Gauss-Newton step, as much of it as lowers the weighted misfit."""
    problem = chosen.problem
    pv = problem.case.data.pv[problem.rows]
    low, high = (np.array([getattr(s, end) for s in problem.searched]) for end in ("low", "high"))
    columns, slopes = problem.tangent(chosen.theta)
    _, found = solve_linear(np.hstack((columns, slopes)) * weight[:, None], pv * weight)
    move = np.zeros(chosen.theta.size)
    move[move.size - slopes.shape[1] :] = found[columns.shape[1] :]
    tried = [_at(chosen, np.clip(chosen.theta + share * move, low, high), pv, weight) for share in SHARES]
    return min(tried, key=lambda f: float(np.sum((weight * f.residual) ** 2)))


def _at(chosen: Fitted, theta: FloatArray, pv: FloatArray, weight: FloatArray) -> Fitted:
    columns = chosen.problem.columns(theta, chosen.problem.rows)[0]
    _, linear = solve_linear(columns * weight[:, None], pv * weight)
    return replace(chosen, theta=theta, linear=linear, residual=pv - columns @ linear)


def jittered_moves(bench: Bench, timed: Fitted) -> Fitted | None:
    """Return moves that come at times of their own as what jittered sampling makes of them; None where it is not that.

    A loop that samples late moves its output late as well, by less than one sample interval.
    """
    _, _, values = timed.problem.split(timed.theta)
    times = np.array(values[0])
    steps = np.abs(bench.case.data.held.steps[1 : times.size + 1])
    told = times[steps > LARGE_MOVE * steps.max()]  # when a small move came, a record hardly tells
    spread = float(np.ptp(np.quantile(told, (0.05, 0.95))))
    if spread > ONE_INTERVAL or jitter_seen(bench, timed) is None:
        return None
    effect = replace(timed.problem.effects[0], name="timing_jitter", place=Place.SENSOR)
    return replace(timed, problem=replace(timed.problem, effects=(effect,)))


def _scaled(bench: Bench, found: Trace, tau: float, sigma: float) -> dict[str, Misfit]:
    """Return the errors with those of the sampling times estimated: `e sigma^2/(sigma^2 + tau^2 slope^2)`."""
    case, chosen = bench.case, found.chosen
    slope = np.gradient(chosen.simulated(np.arange(case.data.t.size)), case.data.t)
    misfits = {}
    for name, rows in (("fitted", bench.fine), ("held_out", bench.held_out)):
        e = case.data.pv[rows] - chosen.simulated(rows)
        misfits[name] = Misfit(_rms(e), _rms(e * sigma / np.sqrt(sigma**2 + tau**2 * slope[rows] ** 2)), sigma)
    return misfits
