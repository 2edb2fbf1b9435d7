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
from autotuner.core.diagnosis.sensor import COARSE, HARMFUL
from autotuner.core.diagnosis.uneven_sampling import MORE_THAN_NOISE, jitter_seen
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.base import Base
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.diagnosis.sensor import Grid, SensorRecord
    from autotuner.core.diagnosis.trace import Trace

CERTAIN = 0.98
STOOD_STILL = "the reading stood still while the PV moved: check the sensor, its converter and the communication"
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
    return all(rms(outside(bench, refined, grid, rows)) < HARDLY * grid.step for rows in (bench.fine, bench.held_out))


def _named(name: str, sizes: dict[str, float], intervals: dict[str, tuple[float, float]]) -> FoundEffect:
    return FoundEffect(name, Place.SENSOR.value, sizes, intervals, CERTAIN, advice=remedy(name, sizes))


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
        before = rms(case.data.pv[whole] - first.best.simulated(whole))
        misfits[name] = Misfit(before, rms(case.data.pv[kept] - found.chosen.simulated(kept)), found.noise)
    sizes = {"samples": float(rows.size), "typical_size": float(np.median(np.abs(off)))}
    return SensorFinding(_named("outliers", sizes, {}), misfits)


def _was_at_rest(bench: Bench, found: Trace, sensor: SensorRecord) -> bool:
    """Return whether the model stands where the reading stood: then it was the process."""
    rows = np.flatnonzero(sensor.frozen)
    off = bench.case.data.pv[rows] - found.chosen.simulated(rows)
    return rms(off) < MORE_THAN_NOISE * math.hypot(found.noise, bench.case.floor)


def _frozen(bench: Bench, found: Trace, sensor: SensorRecord) -> SensorFinding:
    """Return readings that stood still while the PV moved: outliers of a kind of their own."""
    case = bench.case
    rows = np.flatnonzero(sensor.frozen)
    off = np.abs(case.data.pv[rows] - found.chosen.simulated(rows))
    early = case.data.t <= case.fitted_until_s
    misfits = {}
    for name, part, kept in (("fitted", early, bench.fine), ("held_out", ~early, bench.held_out)):
        whole = np.flatnonzero(part)
        before = rms(case.data.pv[whole] - found.alone.simulated(whole))
        misfits[name] = Misfit(before, rms(case.data.pv[kept] - found.chosen.simulated(kept)), found.noise)
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
    left = {name: rms(outside(bench, refined, grid, rows)) for name, rows in parts.items()}
    if left["fitted"] > COARSE * case.grid_noise or case.grid_noise < case.floor:
        return None, plain
    if left["fitted"] > BETWEEN * grid.step and not found.chosen.problem.effects:
        return None, plain
    noise = max(left["fitted"], case.floor)
    misfits = {
        name: Misfit(rms(case.data.pv[rows] - found.alone.simulated(rows)), left[name], noise)
        for name, rows in parts.items()
    }
    sizes = {"step": grid.step}
    finding = SensorFinding(
        _named("sensor_quantisation", sizes, {"step": (0.98 * grid.step, 1.02 * grid.step)}), misfits
    )
    return finding, replace(found, chosen=refined, noise=noise)


def _scaled(bench: Bench, found: Trace, tau: float, sigma: float) -> dict[str, Misfit]:
    """Return the errors with those of the sampling times estimated: `e sigma^2/(sigma^2 + tau^2 slope^2)`."""
    case, chosen = bench.case, found.chosen
    slope = np.gradient(chosen.simulated(np.arange(case.data.t.size)), case.data.t)
    misfits = {}
    for name, rows in (("fitted", bench.fine), ("held_out", bench.held_out)):
        e = case.data.pv[rows] - chosen.simulated(rows)
        misfits[name] = Misfit(rms(e), rms(e * sigma / np.sqrt(sigma**2 + tau**2 * slope[rows] ** 2)), sigma)
    return misfits
