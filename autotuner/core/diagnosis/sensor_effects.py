"""The sensor's own effects as findings, beside those that are fitted: spikes, a coarse grid, jittered sampling."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.advice import remedy
from autotuner.core.diagnosis.coarse_sensor import fitted_to_intervals, outside
from autotuner.core.diagnosis.effect import Place
from autotuner.core.diagnosis.judge import VISIBLE
from autotuner.core.diagnosis.result import FoundEffect, Misfit
from autotuner.core.diagnosis.sensor import COARSE, HARMFUL, JITTER_GAIN, jitter_of
from autotuner.core.signals.noise import inflation

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.base import Base
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.sensor import SensorRecord
    from autotuner.core.diagnosis.trace import Trace

CERTAIN = 0.98
WHITE = 1.8
"""Inflation up to which a residual may be jitter."""
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
    if sensor.grid is not None:
        coarse, found = _coarse(bench, found, sensor)
        if coarse is not None:
            findings.append(coarse)
    elif not found.chosen.problem.effects and (jitter := _jitter(bench, found)) is not None:
        findings.append(jitter)
    return findings, found


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


def _jitter(bench: Bench, found: Trace) -> SensorFinding | None:
    """Return jittered sampling when the residual is white and grows with the slope of the PV."""
    chosen, case = found.chosen, bench.case
    rows = chosen.problem.rows
    resting = rows < case.at_rest
    rest = float(np.std(chosen.residual[resting])) if resting.any() else case.noise
    if chosen.rms < VISIBLE * max(rest, case.floor) or inflation(chosen.residual) > WHITE:
        return None
    everywhere = np.arange(case.data.t.size)
    slope = np.gradient(chosen.simulated(everywhere), case.data.t)[rows]
    tau, gain = jitter_of(chosen.residual, slope, max(rest, case.floor))
    if gain < JITTER_GAIN or tau * _rms(slope) < 0.7 * chosen.rms:
        return None
    sizes = {"spread_s": tau * math.sqrt(12.0)}
    return SensorFinding(_named("timing_jitter", sizes, {}), _scaled(bench, found, tau, max(rest, case.floor)))


def _scaled(bench: Bench, found: Trace, tau: float, sigma: float) -> dict[str, Misfit]:
    """Return the errors with those of the sampling times estimated: `e sigma^2/(sigma^2 + tau^2 slope^2)`."""
    case, chosen = bench.case, found.chosen
    slope = np.gradient(chosen.simulated(np.arange(case.data.t.size)), case.data.t)
    misfits = {}
    for name, rows in (("fitted", bench.fine), ("held_out", bench.held_out)):
        e = case.data.pv[rows] - chosen.simulated(rows)
        misfits[name] = Misfit(_rms(e), _rms(e * sigma / np.sqrt(sigma**2 + tau**2 * slope[rows] ** 2)), sigma)
    return misfits
