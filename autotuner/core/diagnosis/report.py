"""From what the search found to what the reader is told."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.advice import remedy, separating
from autotuner.core.diagnosis.blind import blind_spots
from autotuner.core.diagnosis.intervals import effect_intervals, process_covariance, process_intervals
from autotuner.core.diagnosis.judge import VISIBLE
from autotuner.core.diagnosis.result import Diagnosis, FoundEffect, Misfit, Outcome, Traces
from autotuner.core.diagnosis.sensor_effects import SensorFinding, sensor_findings
from autotuner.core.diagnosis.wise import NOMINAL, Known, both_gains, calmer_note
from autotuner.core.process import model_to_dict
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.base import Base
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.blind import Spot
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.diagnosis.sensor import SensorRecord
    from autotuner.core.diagnosis.trace import Trace
    from autotuner.core.diagnosis.wise import Design
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

ABOUT_AS_WELL, ALIKE_MISFIT = 8.0, 1.04
"""Difference of the criterion, and ratio of the misfits, under which two explanations count as equally good."""
ELSEWHERE = 1.5
"""How many times more may be left on the part not fitted before the effect is less sure."""
LESS_THAN_NOISE = 0.5
"""Root mean square difference of two simulated PVs, in noise sigmas, under which no record tells them apart."""
MUCH_SMALLER = 0.22
"""Misfit after over before from which an effect counts as the explanation although colour remains."""
STILL_HELD_OUT = 2.0
"""Misfit over noise on the part not fitted that is allowed for `explained`."""
UNSURE = 0.5
"""Highest confidence of the nearest effect where the verdict is `unexplained`."""
OWN_TIMES = (
    "every move of the output comes late by a time of its own; on the part that was not fitted these times are not "
    "known, and the error there is that of their mean"
)


def reported(
    bench: Bench,
    found: Trace,
    sensor: SensorRecord,
    first: Base,
    model: ProcessModel | None,
    recording: Recording,
    asked: Design = NOMINAL,
) -> Diagnosis:
    """Return the diagnosis.

    Parameters
    ----------
    bench : Bench
        The recording, with what is no measurement left out.
    found : Trace
        What the search found.
    sensor : SensorRecord
        What the sensor did.
    first : Base
        The process alone with all samples.
    model : ProcessModel or None
        The declared model.
    recording : Recording
        As it came.
    asked : Design
        How gains are chosen.
    """
    findings, found = sensor_findings(bench, found, sensor, first)
    of_sensor = tuple(f.effect for f in findings)
    told = {e.name for e in of_sensor}
    effects = (*(e for e in _effects(bench, found) if e.name not in told), *of_sensor)
    error = _errors(bench, found, findings)
    verdict = _verdict(effects, error)
    if verdict == "unexplained":
        effects = tuple(replace(e, confidence=min(e.confidence, UNSURE)) for e in effects)
    before = model if model is not None else found.alone.process()
    after = found.chosen.process()
    covariance = process_covariance(bench, found.chosen)
    blind = blind_spots(bench, found.chosen, found.noise)
    alone = Known(before, process_covariance(bench, found.alone) if model is None else None)
    gains = both_gains(alone, Known(after, covariance), effects, bench.case, asked)
    notes = (*_of_blindness(blind), *_notes(bench, found, sensor, effects, error, model), *calmer_note(gains))
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        runner_up=_runner_up(bench, found, effects),
        error=error,
        model={"before": model_to_dict(before), "after": _model(found, covariance)},
        gains=gains,
        notes=(*recording.notes, *notes),
        summary=_summary(verdict, effects, error, blind),
        traces=_traces(bench, found),
        process=after,
        covariance=covariance,
    )


def _model(found: Trace, covariance: FloatArray | None) -> dict[str, object]:
    told: dict[str, object] = dict(model_to_dict(found.chosen.process()))
    share = next((s["share"] for s in found.chosen.sizes() if "share" in s), None)
    if share is not None and share < 1.0:
        told["K"] = found.chosen.process().K / (1.0 - share)
    return {**told, "interval95": process_intervals(found.chosen, covariance)}


def _errors(bench: Bench, found: Trace, findings: list[SensorFinding]) -> dict[str, Misfit]:
    parts = {"fitted": bench.fine, "held_out": bench.held_out}
    pv = bench.case.data.pv
    error = {
        name: Misfit(
            rms(pv[rows] - found.alone.simulated(rows)), rms(pv[rows] - found.chosen.simulated(rows)), found.noise
        )
        for name, rows in parts.items()
    }
    for finding in findings:
        error = {name: finding.misfits.get(name, misfit) for name, misfit in error.items()}
    return error


def _verdict(effects: tuple[FoundEffect, ...], error: dict[str, Misfit]) -> Outcome:
    """Return the verdict by nothing but the errors that stand beside it: the two never contradict each other."""
    fitted, held = error["fitted"], error["held_out"]
    if effects:
        small = fitted.after < max(VISIBLE * fitted.noise, MUCH_SMALLER * fitted.before)
        holds = not held.after > max(STILL_HELD_OUT * held.noise, 1.5 * MUCH_SMALLER * held.before)
        return "explained" if small and holds else "unexplained"
    if not fitted.after < VISIBLE * fitted.noise or held.after > STILL_HELD_OUT * held.noise:
        return "unexplained"
    as_it_was = fitted.before < VISIBLE * fitted.noise and not held.before > STILL_HELD_OUT * held.noise
    return "adequate" if as_it_was else "explained"


def _effects(bench: Bench, found: Trace) -> tuple[FoundEffect, ...]:
    chosen = found.chosen
    if not chosen.problem.effects:
        return ()
    left = max(chosen.rms / found.noise, bench.held_out_error(chosen) / found.noise / ELSEWHERE, 1.0)
    result = []
    intervals = effect_intervals(bench, chosen)
    for effect, sizes, interval in zip(chosen.problem.effects, chosen.sizes(), intervals, strict=True):
        others = tuple(e.name for e in chosen.problem.effects if e is not effect)
        rivals = _rivals(bench, found, others)
        alike = tuple(n for n, above in rivals.items() if n != effect.name and above < ABOUT_AS_WELL)
        weight = sum(math.exp(-0.5 * max(a, 0.0)) for n, a in rivals.items() if n != effect.name)
        sure = min(1.0 / (1.0 + weight), 0.999) * min(1.0, VISIBLE / left)
        advice = remedy(effect.name, sizes)
        result.append(FoundEffect(effect.name, effect.place.value, sizes, interval, sure, alike, effect.form, advice))
    return tuple(sorted(result, key=lambda e: -_weight(bench, found, e.name)))


def _weight(bench: Bench, found: Trace, name: str) -> float:
    """Return how much worse the best explanation without an effect is."""
    without = [c.mean_square for c in (*found.pool, found.alone) if name not in c.names]
    return min(without) if without else bench.case.floor


def _rivals(bench: Bench, found: Trace, others: tuple[str, ...]) -> dict[str, float]:
    """Return, by name, how far each explanation with the same other effects lies above the chosen one."""
    inflated = bench.colour(found.chosen)
    reference = bench.criterion(found.chosen, inflated)
    rivals: dict[str, float] = {}
    for candidate in found.pool:
        names = list(candidate.names)
        held_alike = candidate.problem.fixed == found.chosen.problem.fixed
        if not held_alike or len(names) != len(others) + 1 or not set(others) <= set(names):
            continue
        for name in others:
            names.remove(name)
        near = candidate.rms < ALIKE_MISFIT * math.hypot(found.chosen.rms, bench.case.floor)
        above = bench.criterion(candidate, inflated) - reference + (0.0 if near else ABOUT_AS_WELL)
        if _apart(bench, found.chosen, candidate) < LESS_THAN_NOISE * found.noise:
            above = min(above, 0.0)
        rivals[names[0]] = min(above, rivals.get(names[0], math.inf))
    return rivals


def _apart(bench: Bench, one: Fitted, other: Fitted) -> float:
    """Return the root mean square difference of two simulated PVs over both parts of the record, PV."""
    rows = np.concatenate((bench.fine, bench.held_out))
    return rms(one.simulated(rows) - other.simulated(rows))


def _runner_up(bench: Bench, found: Trace, effects: tuple[FoundEffect, ...]) -> dict[str, object] | None:
    named = {e.name for e in effects}
    others = [c for c in found.pool if not set(c.names) <= named]
    if not others:
        return None
    nearest = bench.best(others)
    return {
        "effects": [
            {"name": e.name, "place": e.place.value, "parameters": sizes}
            for e, sizes in zip(nearest.problem.effects, nearest.sizes(), strict=True)
        ],
        "fitted": nearest.rms,
        "held_out": bench.held_out_error(nearest),
    }


def _of_blindness(blind: Sequence[Spot]) -> tuple[str, ...]:
    return (f"this record is blind to {'; '.join(spot.told for spot in blind)}",) if blind else ()


def _notes(
    bench: Bench,
    found: Trace,
    sensor: SensorRecord,
    effects: tuple[FoundEffect, ...],
    error: dict[str, Misfit],
    model: ProcessModel | None,
) -> tuple[str, ...]:
    fitted = error["fitted"]
    remains = fitted.after / fitted.noise
    t = bench.case.data.t
    notes = [
        *(note for e in effects for note in separating(e.name, e.indistinguishable)),
    ]
    if effects and remains > VISIBLE:
        notes.append(
            f"what remains is {remains:.1f} times the noise and not white: the form of the effect differs from the "
            "catalogue's, or something smaller is hidden behind it"
        )
    if any(e.form == "uneven" and e.unseen_after for e in found.chosen.problem.effects):
        notes.append(OWN_TIMES)
    if any(e.form == "frozen" for e in effects):
        since = float(t[np.argmax(sensor.frozen)])
        notes.append(f"the reading stands still from {since:.4g} s of the record: a frozen sensor; left out")
    if sensor.spikes.any():
        notes.append(f"{int(sensor.spikes.sum())} samples were left out as no measurements")
    return (*notes, *found.notes, *_changed_values(found, model))


def _changed_values(found: Trace, model: ProcessModel | None) -> list[str]:
    """Return what the record says of the declared values."""
    if model is None or found.chosen.problem.fixed is not None:
        return []
    after = found.chosen.process().parameters()
    told = [f"{n} {v:.4g} declared, {after[n]:.4g} on record" for n, v in model.parameters().items() if n in after]
    return ["the declared values are not the record's: " + "; ".join(told)] if told else []


def _summary(
    verdict: Outcome, effects: tuple[FoundEffect, ...], error: dict[str, Misfit], blind: Sequence[Spot]
) -> str:
    held = error["held_out"]
    ratio = f"{held.before / held.noise:.1f} to {held.after / held.noise:.1f} noise sigmas on the part not fitted"
    names = " and ".join(e.name for e in effects)
    if verdict == "explained":
        return f"{names or 'other values of the same model'}: error from {ratio}"
    if verdict == "unexplained":
        near = f"; nearest is {names}, which leaves too much" if names else ""
        return f"something is missing that no known effect explains (error {ratio}){near}"
    grave = [spot.told for spot in blind if spot.grave]
    spots = f"; it is blind to {' and '.join(grave)}" if grave else ""
    return f"nothing is missing that this record can show{spots}"


def _traces(bench: Bench, found: Trace) -> Traces:
    case = bench.case
    held, t = case.data.held, case.data.t
    rows = np.arange(t.size)
    until_next = np.searchsorted(held.times, np.append(t[1:], np.inf), side="left") - 1
    output = held.levels[np.maximum(until_next, 0)] + case.output0
    before, after = found.alone.simulated(rows) + case.pv0, found.chosen.simulated(rows) + case.pv0
    return Traces(t, output, case.data.pv + case.pv0, before, after, case.fitted_until_s)
