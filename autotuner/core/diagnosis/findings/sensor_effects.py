"""Effects of the sensor as findings, in addition to the fitted ones: spikes, quantisation, jittered sampling.

A model fitted to interval data: a coarse reading only bounds the PV.

    pv_k <- min(max(simulated_k, reading_k - half), reading_k + half),   then fit again

(expectation and maximisation for interval data; Dempster, Laird, Rubin, J. R. Stat. Soc. B 39, 1977). The remainder is
the distance of the simulated PV from the interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.extended_model import Fitted
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.findings.advice import remedy
from autotuner.core.diagnosis.findings.result import FoundEffect
from autotuner.core.diagnosis.record.sensor import COARSE, HARMFUL
from autotuner.core.diagnosis.search.search import without
from autotuner.core.diagnosis.search.uneven_sampling import MORE_THAN_NOISE, jitter_seen
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.sensor import Grid, SensorRecord
    from autotuner.core.diagnosis.search.trace import Trace
    from autotuner.core.model.arrays import FloatArray

CERTAIN = 0.98
"""Confidence of an effect that is counted in the readings, not inferred from a fit."""
STOOD_STILL = "the reading stood still while the PV moved: check the sensor, its converter and the communication"
HARDLY = 0.12
"""Distance from the intervals, in steps, below which no other effect is searched."""
BETWEEN = 0.3
"""Distance outside of the grid's allowance, in steps, up to which the grid explains the record."""


@dataclass(frozen=True, slots=True)
class SensorFinding:
    """An effect of the sensor, and the spread of its sampling times, s, which leaves an error where the PV moves."""

    effect: FoundEffect
    spread_s: float = 0.0


def sensor_findings(context: FitContext, found: Trace, sensor: SensorRecord) -> tuple[list[SensorFinding], Trace]:
    """Return the sensor's effects, and the trace as they leave it."""
    findings = []
    spikes = _spikes(context, found, sensor)
    if spikes is not None:
        findings.append(spikes)
    elif sensor.frozen.any() and not _was_at_rest(context, found, sensor):
        findings.append(_frozen(context, found, sensor))
    if sensor.grid is not None:
        coarse, found = _coarse(context, found, sensor)
        if coarse is not None:
            findings.append(coarse)
    elif not set(found.chosen.names) - {"timing_jitter"} and (jitter := jitter_seen(context, found.chosen)) is not None:
        tau, _ = jitter
        findings.append(SensorFinding(_named("timing_jitter", {"spread_s": tau * math.sqrt(12.0)}, {}), tau))
    return findings, found


def explained_by_grid(context: FitContext, candidate: Fitted, grid: Grid) -> bool:
    """Return whether a process fitted to the intervals of a coarse sensor lies almost within them."""
    if not _is_coarse(context):
        return False
    refined = fitted_to_intervals(context, candidate, grid)
    return all(
        rms(outside(context, refined, grid, rows)) < HARDLY * grid.step for rows in (context.fine, context.held_out)
    )


def _is_coarse(context: FitContext) -> bool:
    """Return whether the steps of the readings are seen beside the other noise."""
    return context.dataset.grid_noise >= max(context.dataset.floor, context.dataset.noise / 2.0)


def _named(name: str, sizes: dict[str, float], intervals: dict[str, tuple[float, float]]) -> FoundEffect:
    return FoundEffect(name, Place.SENSOR.value, sizes, intervals, CERTAIN, advice=remedy(name, sizes))


def _spikes(context: FitContext, found: Trace, sensor: SensorRecord) -> SensorFinding | None:
    """Return the spikes when they are more than the noise's own tail."""
    dataset = context.dataset
    rows = np.flatnonzero(sensor.spikes)
    if not rows.size:
        return None
    off = dataset.data.pv[rows] - found.chosen.simulated(rows)
    if float(off @ off) < HARMFUL * dataset.data.t.size * max(found.noise, found.chosen.rms) ** 2:
        return None
    sizes = {"samples": float(rows.size), "typical_size": float(np.median(np.abs(off)))}
    return SensorFinding(_named("outliers", sizes, {}))


def _was_at_rest(context: FitContext, found: Trace, sensor: SensorRecord) -> bool:
    """Return whether the model is as still as the reading was: then it was the process."""
    rows = np.flatnonzero(sensor.frozen)
    off = context.dataset.data.pv[rows] - found.chosen.simulated(rows)
    return rms(off) < MORE_THAN_NOISE * math.hypot(found.noise, context.dataset.floor)


def _frozen(context: FitContext, found: Trace, sensor: SensorRecord) -> SensorFinding:
    """Return frozen readings while the PV moved, which are a kind of outliers."""
    dataset = context.dataset
    rows = np.flatnonzero(sensor.frozen)
    off = np.abs(dataset.data.pv[rows] - found.chosen.simulated(rows))
    sizes = {"samples": float(rows.size), "typical_size": float(np.median(off))}
    named = replace(_named("outliers", sizes, {}), form="frozen", advice=STOOD_STILL)
    return SensorFinding(named)


def _coarse(context: FitContext, found: Trace, sensor: SensorRecord) -> tuple[SensorFinding | None, Trace]:
    """Return the quantisation when it is coarser than the other noise, and the model fitted to the intervals."""
    grid = sensor.grid
    assert grid is not None  # noqa: S101 - asked before
    dataset = context.dataset
    plain = replace(found, chosen=found.chosen)
    refined = fitted_to_intervals(context, _beside_rounding(context, found.chosen, grid), grid)
    parts = {"fitted": context.fine, "held_out": context.held_out}
    left = {name: rms(outside(context, refined, grid, rows)) for name, rows in parts.items()}
    if left["fitted"] > COARSE * dataset.grid_noise or dataset.grid_noise < dataset.floor:
        return None, plain
    if left["fitted"] > BETWEEN * grid.step and not found.chosen.problem.effects:
        return None, plain
    size = {"step": (0.98 * grid.step, 1.02 * grid.step)}
    finding = SensorFinding(_named("sensor_quantisation", {"step": grid.step}, size))
    return finding, replace(found, chosen=refined)


def _beside_rounding(context: FitContext, chosen: Fitted, grid: Grid) -> Fitted:
    """Return an explanation without the effects that rounding stands for: the PV lies within the readings without them.

    One effect stays: the process alone was compared before the search.
    """
    effects = chosen.problem.effects
    if len(effects) < 2 or not _is_coarse(context):
        return chosen
    for plainer in (without(context, chosen, effect) for effect in effects):
        if is_physical(plainer) and explained_by_grid(context, plainer, grid):
            return _beside_rounding(context, plainer, grid)
    return chosen


ROUNDS = 8
"""Most rounds of estimating the moments of the samples and the model in turn."""
STEPS = 6
"""Most steps of the optimiser in one round, which starts where the last one ended."""


def fitted_to_intervals(context: FitContext, candidate: Fitted, grid: Grid) -> Fitted:
    """Return the candidate fitted to the intervals of the readings."""
    dataset = context.dataset
    rows = np.arange(dataset.data.t.size)
    for _ in range(ROUNDS):
        allowed = dataset.data.pv + outside_free(candidate.simulated(rows) - dataset.data.pv, grid)
        moved = replace(dataset, data=replace(dataset.data, pv=allowed))
        candidate = fit(replace(candidate.problem, dataset=moved), candidate.theta, STEPS)
    return candidate


def outside_free(off: FloatArray, grid: Grid) -> FloatArray:
    """Return how far a reading may be moved towards a simulated PV that is `off` from it."""
    result: FloatArray = np.clip(off, -grid.half, grid.half)
    return result


def outside(context: FitContext, candidate: Fitted, grid: Grid, rows: np.ndarray) -> FloatArray:
    """Return the distance of a simulated PV from the intervals of the readings, PV."""
    off = context.dataset.data.pv[rows] - candidate.simulated(rows)
    result: FloatArray = off - np.clip(off, -grid.half, grid.half)
    return result
