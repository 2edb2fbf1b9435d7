"""Report of a diagnosis: results of the search in the terms of the reader."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.extended.both_parts import to_both_parts
from autotuner.core.diagnosis.extended.coloured_noise import coloured_noise
from autotuner.core.diagnosis.extended.effect import ONE_LAG, TWO_LAGS
from autotuner.core.diagnosis.extended.extended_model import without_rounding
from autotuner.core.diagnosis.extended.intervals import (
    effect_intervals,
    process_covariance,
    process_intervals,
    whole_gain,
)
from autotuner.core.diagnosis.findings.advice import remedy, separating
from autotuner.core.diagnosis.findings.doubts import (
    doubts_about,
    doubts_about_course,
    doubts_about_errors,
    doubts_about_moments,
    doubts_about_process,
    doubts_about_readings,
)
from autotuner.core.diagnosis.findings.errors_by_part import Errors
from autotuner.core.diagnosis.findings.gain_comparison import (
    NOMINAL,
    Known,
    both_gains,
    calmer_note,
    missing_note,
    no_design_note,
)
from autotuner.core.diagnosis.findings.gain_proof import doubts_about_sign, why_no_gains
from autotuner.core.diagnosis.findings.judgement import FEW, VISIBLE, is_close, verdict_of
from autotuner.core.diagnosis.findings.residual_dependence import dependences, in_words
from autotuner.core.diagnosis.findings.result import Diagnosis, FoundEffect, Misfit, Outcome, comes_from_outside
from autotuner.core.diagnosis.findings.sensor_effects import sensor_findings
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.diagnosis.search.detectability import blind_spots
from autotuner.core.diagnosis.search.judge import is_foreseen, noise_of
from autotuner.core.diagnosis.search.neighbours import neighbours
from autotuner.core.diagnosis.search.simplify import with_third_lag
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.process import model_to_dict
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.coloured_noise import Innovations
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.extended.intervals import Neighbours
    from autotuner.core.diagnosis.findings.gain_comparison import Design
    from autotuner.core.diagnosis.record.parts import Parts
    from autotuner.core.diagnosis.record.sensor import SensorRecord
    from autotuner.core.diagnosis.search.detectability import Spot
    from autotuner.core.diagnosis.search.trace import Trace
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

ABOUT_AS_WELL, ALIKE_MISFIT = 8.0, 1.04
"""Difference of the criterion, and ratio of the misfits, under which two explanations count as equally good."""
ELSEWHERE = 1.5
"""Ratio of the errors on the held-out and the fitted part from which the effect is less certain."""
LESS_THAN_NOISE = 0.5
"""Root mean square difference of two simulated PVs, in noise sigmas, under which no record distinguishes them."""
OWN_ORDER = frozenset({ONE_LAG, TWO_LAGS})
"""Forms of further lags, which belong to the process: named last, after external effects."""
UNSURE = 0.5
"""Highest confidence of a hypothesis."""
NO_GAINS: dict[str, object] = {"before": None, "after": None}
"""What is reported where no gains were asked of a design."""
HYPOTHESES = "the effects are hypotheses; model and gains are those of the model without them"
TIME_SPENT = "the time limit ended the search: the effects are the best so far; give more time for an explanation"
TEST_FAILS = (
    "on the test part the error is {:.1f} times what noise leaves: something happens there that the other parts do not "
    "show"
)
TEST_REFUTES = (
    "on the test part the error is larger with the effects ({:.4g}) than without ({:.4g}): they do not explain what "
    "happens there"
)
OPEN_LATER = (
    "on the test part an error of {:.3g} is expected, of which noise makes {:.3g}: the record leaves open how the "
    "effects act there"
)
COLOURED = (
    "the residual is autocorrelated noise: {:.3g} in all, of which the samples before it predict all but {:.3g} "
    "({:.3g} on the selection part); an unmeasured disturbance, and no missing effect"
)
WAITS = (
    "the PV waits while the output travels, and then jumps, as with a valve that sticks; but no friction that was "
    "tried explains the record"
)
OWN_TIMES = (
    "every move of the output comes late by a time of its own; on the part that was not fitted these times are not "
    "known, and the error there is that of their mean"
)


def reported(
    context: FitContext,
    found: Trace,
    sensor: SensorRecord,
    first: Base,
    model: ProcessModel | None,
    parts: Parts,
    requested: Design = NOMINAL,
) -> Diagnosis:
    """Return the diagnosis.

    `context` has the record up to its test part, `parts` the whole one. `found` is the search, `sensor` the sensor's
    effects, `first` the process alone, `model` the declared model or None, `requested` the design of the gains.
    """
    effects, found, spread_s = _all_effects(context, found, sensor, model)
    coloured = coloured_noise(context, found.chosen) if all(e.form in OWN_ORDER for e in effects) else None
    noise = max(min(noise_of(context, first.best), found.noise), 0.0 if coloured is None else coloured.noise)
    errors = Errors(context, parts, found.alone, found.chosen, noise, spread_s)
    error = errors.by_part()
    final = to_both_parts(context, found.chosen)
    near = neighbours(context, found.chosen, found.pool)
    covariance = process_covariance(context, final, near)
    judged = model is None and not context.dataset.tuned
    sign = doubts_about_sign(context, found) if judged else []
    doubts = [*_doubts(context, found, effects, errors, error["selection"], covariance, sensor), *sign]
    verdict, cut = _outcome(context, found.chosen, effects, error, doubts, has_memory=coloured is not None)
    kept = verdict in {"explained", "adequate"}
    effects = effects if kept else tuple(replace(e, confidence=min(e.confidence, UNSURE)) for e in effects)
    alone = _known_alone(context, found.alone, model)
    described = model_to_dict(alone.model)
    after = Known(final.process(), covariance) if kept else alone
    blind = blind_spots(context, found.chosen, found.noise)
    barred = why_no_gains(parts.before_test, first, found, verdict, error["fitted"], sign) if judged else None
    gains = NO_GAINS if barred else both_gains(alone, after, effects if kept else (), context.dataset, requested)
    missing = () if kept else dependences(context, found.alone, noise)
    notes = [
        *in_words(missing),
        *([TIME_SPENT] if cut else ()),
        *([f"this record is blind to {'; '.join(spot.words for spot in blind)}"] if blind else []),
        *_notes(context, found, sensor, effects, error, model),
        *_of_the_gains(gains, effects, after, requested),
        *([*doubts, HYPOTHESES] if effects and not kept else ()),
        *_of_the_errors(error["held_out"], coloured),
        *([f"no gains: {barred}"] if barred else ()),
    ]
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        runner_up=_runner_up(context, found, effects),
        error=error,
        model={"before": described, "after": _model(context, final, near, covariance) if kept else described},
        gains=gains,
        notes=(*parts.whole.notes, *notes),
        summary=_summary(verdict, effects, error, blind, doubts, cut=cut),
        traces=errors.traces(),
        process=after.model,
        covariance=after.covariance,
        blocks=errors.of_blocks(),
        missing=missing,
    )


def _known_alone(context: FitContext, alone: Fitted, model: ProcessModel | None) -> Known:
    """Return the model without effects: the declared one, else that of the record."""
    if model is not None:
        return Known(model)
    plain = to_both_parts(context, alone)
    return Known(plain.process(), process_covariance(context, plain))


def _all_effects(
    context: FitContext, found: Trace, sensor: SensorRecord, model: ProcessModel | None
) -> tuple[tuple[FoundEffect, ...], Trace, float]:
    """Return the effects with the sensor's own, the trace as those leave it, and the spread of sampling times, s.

    Without a declared model, the process of the trace has a third lag where the record shows one.
    """
    findings, found = sensor_findings(context, found, sensor)
    chosen = with_third_lag(context, found.chosen) if model is None else found.chosen
    named = {f.effect.name for f in findings}
    effects = (*(e for e in _effects(context, found, chosen) if e.name not in named), *(f.effect for f in findings))
    effects = tuple(sorted(effects, key=lambda e: e.form in OWN_ORDER))
    alone = chosen if found.chosen is found.alone else found.alone
    return effects, replace(found, alone=alone, chosen=chosen), sum(f.spread_s for f in findings)


def _outcome(
    context: FitContext,
    chosen: Fitted,
    effects: tuple[FoundEffect, ...],
    error: dict[str, Misfit],
    doubts: list[str],
    *,
    has_memory: bool,
) -> tuple[Outcome, bool]:
    """Return the verdict, and whether it is that of a search which the time limit ended."""
    foreseen = not effects and is_foreseen(context, chosen, chosen.rms)
    verdict = verdict_of(effects, error, doubts, has_memory=has_memory, foreseen=foreseen)
    cut = context.dataset.budget.spent and verdict != "adequate"
    return ("unexplained" if cut else verdict), cut


def _doubts(
    context: FitContext,
    found: Trace,
    effects: tuple[FoundEffect, ...],
    errors: Errors,
    selection: Misfit,
    covariance: FloatArray | None,
    sensor: SensorRecord,
) -> list[str]:
    """Return why the effects are hypotheses only."""
    chosen = found.chosen
    until = int(np.flatnonzero(context.dataset.fitted)[-1]) + 1
    _, delay_s, _ = chosen.problem.split(chosen.theta)
    before, after = (to_both_parts(context, f).process() for f in (found.alone, chosen))
    return [
        *doubts_about(effects, in_loop=context.dataset.in_loop),
        *doubts_about_course(context, chosen),
        *doubts_about_moments(effects, context.dataset, delay_s),
        *doubts_about_process(before, after, covariance, in_loop=context.dataset.in_loop),
        *doubts_about_errors(selection, errors.of_the_later_selection()),
        *doubts_about_readings(sensor.grid, context.dataset.data.pv[:until]),
    ]


def _of_the_errors(held: Misfit, coloured: Innovations | None) -> list[str]:
    """Return the notes on the test part and on autoregressive noise."""
    notes = []
    if _is_refuted(held):
        notes.append(TEST_REFUTES.format(held.after, held.before))
    if held.after > FEW * held.expected:
        notes.append(TEST_FAILS.format(held.after / max(held.expected, SMALLEST_DIVISOR)))
    if _is_open(held):
        notes.append(OPEN_LATER.format(held.expected, held.noise))
    if coloured is not None:
        notes.append(COLOURED.format(coloured.noise, coloured.fitted, coloured.selection))
    return notes


def _of_the_gains(
    gains: dict[str, object], effects: Sequence[FoundEffect], known: Known, requested: Design
) -> list[str]:
    """Return the notes on the gains, and on why there are none."""
    unsolved = [] if gains is NO_GAINS else no_design_note(gains, known, requested)
    return [*calmer_note(gains), *missing_note(gains, effects), *unsolved]


def _is_open(held: Misfit) -> bool:
    """Return whether a correct model may visibly err by more than noise on the test part."""
    return held.expected > VISIBLE * held.noise


def _is_refuted(held: Misfit) -> bool:
    """Return whether the effects visibly enlarge the error on the test part: reported, but nothing is chosen by it."""
    return held.after > max(held.before, VISIBLE * held.expected)


def _model(context: FitContext, final: Fitted, near: Neighbours, covariance: FloatArray | None) -> dict[str, object]:
    reported: dict[str, object] = dict(model_to_dict(final.process()))
    ends = process_intervals(final, covariance)
    whole = whole_gain(context, final, near)
    if whole is not None:
        reported["K"] = whole[0]
        ends = {**ends, "K": whole[1]} if ends else ends
    return {**reported, "interval95": ends}


def _effects(context: FitContext, found: Trace, chosen: Fitted) -> tuple[FoundEffect, ...]:
    """Return the effects as `chosen` has them; they compete with all others beside the process of the search."""
    if not chosen.problem.effects:
        return ()
    elsewhere = context.held_out_error(chosen) / context.expected(chosen, found.noise)
    left = max(chosen.rms / found.noise, elsewhere / ELSEWHERE, 1.0)
    result = []
    final = to_both_parts(context, chosen)
    intervals = effect_intervals(context, final, neighbours(context, chosen, found.pool))
    names = chosen.reported_names()
    places = {e.name: e.place for c in found.pool for e in c.problem.effects}
    for effect, name, sizes, interval in zip(chosen.problem.effects, names, final.sizes(), intervals, strict=True):
        others = tuple(e.name for e in chosen.problem.effects if e is not effect)
        rivals = _rivals(context, found, others)
        alike = tuple(n for n, above in rivals.items() if n != effect.name and above < ABOUT_AS_WELL)
        weights = {n: math.exp(-0.5 * max(a, 0.0)) for n, a in rivals.items() if n != effect.name}
        outside = comes_from_outside(effect.name, effect.place)
        alike_beside = (places[n] is effect.place or (outside and comes_from_outside(n, places[n])) for n in weights)
        here = sum(weight for weight, same in zip(weights.values(), alike_beside, strict=True) if same)
        sure = min(1.0 / (1.0 + sum(weights.values())), 0.999) * min(1.0, VISIBLE / left)
        values = (sizes, interval, sure, alike, effect.form, remedy(name, sizes, interval), sure * (1.0 + here))
        result.append(FoundEffect(name, effect.place.value, *values))
    inside = dict(zip(names, chosen.names, strict=True))
    return tuple(without_rounding(result, lambda e: -_weight(context, found, inside[e.name])))


def _weight(context: FitContext, found: Trace, name: str) -> float:
    """Return how much worse the best explanation without an effect is."""
    without = [c.mean_square for c in (*found.pool, found.alone) if name not in c.names]
    return min(without) if without else context.dataset.floor


def _rivals(context: FitContext, found: Trace, others: tuple[str, ...]) -> dict[str, float]:
    """Return, by name, how far each explanation with the same other effects lies above the chosen one."""
    inflated = context.colour(found.chosen)
    reference = context.criterion(found.chosen, inflated)
    rivals: dict[str, float] = {}
    for candidate in found.pool:
        names = list(candidate.names)
        held_alike = candidate.problem.fixed == found.chosen.problem.fixed
        if not held_alike or len(names) != len(others) + 1 or not set(others) <= set(names):
            continue
        for name in others:
            names.remove(name)
        near = candidate.rms < ALIKE_MISFIT * math.hypot(found.chosen.rms, context.dataset.floor)
        above = context.criterion(candidate, inflated) - reference + (0.0 if near else ABOUT_AS_WELL)
        if _apart(context, found.chosen, candidate) < LESS_THAN_NOISE * found.noise:
            above = min(above, 0.0)
        rivals[names[0]] = min(above, rivals.get(names[0], math.inf))
    return rivals


def _apart(context: FitContext, one: Fitted, other: Fitted) -> float:
    """Return the root mean square difference of two simulated PVs over both parts of the record, PV."""
    rows = np.concatenate((context.fine, context.held_out))
    return rms(one.simulated(rows) - other.simulated(rows))


def _runner_up(context: FitContext, found: Trace, effects: tuple[FoundEffect, ...]) -> dict[str, object] | None:
    named = {e.name for e in effects}
    others = [c for c in found.pool if not set(c.names) <= named]
    if not others:
        return None
    nearest = context.best(others)
    return {
        "effects": [
            {"name": e.name, "place": e.place.value, "parameters": sizes}
            for e, sizes in zip(nearest.problem.effects, nearest.sizes(), strict=True)
        ],
        "fitted": nearest.rms,
        "held_out": context.held_out_error(nearest),
    }


def _notes(
    context: FitContext,
    found: Trace,
    sensor: SensorRecord,
    effects: tuple[FoundEffect, ...],
    error: dict[str, Misfit],
    model: ProcessModel | None,
) -> tuple[str, ...]:
    fitted = error["fitted"]
    remains = fitted.after / max(fitted.expected, SMALLEST_DIVISOR)
    t = context.dataset.data.t
    notes = [
        *(note for e in effects for note in separating(e.name, e.indistinguishable)),
    ]
    if effects and remains > VISIBLE:
        notes.append(
            f"what remains is {remains:.1f} times the noise and not white: the form of the effect differs from the "
            "catalogue's, or something smaller is hidden behind it"
        )
    if waiting_of(context.dataset).sticks and not any(e.name in SLIPS for e in effects):
        notes.append(WAITS)
    if any(e.form == "uneven" and e.unseen_after for e in found.chosen.problem.effects):
        notes.append(OWN_TIMES)
    if any(e.form == "frozen" for e in effects):
        since = float(t[np.argmax(sensor.frozen)])
        notes.append(f"the reading stands still from {since:.4g} s of the record: a frozen sensor; left out")
    if sensor.spikes.any():
        notes.append(f"{int(sensor.spikes.sum())} samples were left out as no measurements")
    return (*notes, *found.notes, *_changed_values(to_both_parts(context, found.chosen), model))


def _changed_values(final: Fitted, model: ProcessModel | None) -> list[str]:
    """Return how the record compares with the declared values."""
    if model is None or final.problem.fixed is not None:
        return []
    after = final.process().parameters()
    differing = [f"{n} {v:.4g} declared, {after[n]:.4g} on record" for n, v in model.parameters().items() if n in after]
    return ["the declared values are not the record's: " + "; ".join(differing)] if differing else []


def _summary(
    verdict: Outcome,
    effects: tuple[FoundEffect, ...],
    error: dict[str, Misfit],
    blind: Sequence[Spot],
    doubts: Sequence[str],
    *,
    cut: bool,
) -> str:
    """Return the verdict in a sentence, with what decided it."""
    held = error["held_out"]
    noise = max(held.noise, SMALLEST_DIVISOR)
    ratio = f"{held.before / noise:.1f} to {held.after / noise:.1f} noise sigmas on the part kept for the test"
    if _is_open(held):
        ratio += f", where {held.expected / noise:.1f} are expected"
    names = " and ".join(e.name for e in effects)
    if verdict == "adequate":
        grave = [spot.words for spot in blind if spot.grave]
        spots = f"; it is blind to {' and '.join(grave)}" if grave else ""
        return f"nothing is missing that this record can show{spots}"
    if cut:
        return f"the time limit ended the search; best so far is {names or 'the process alone'} (error {ratio})"
    if effects and verdict != "unexplained" and _is_refuted(held):
        return f"the test part speaks against {names}: error from {ratio}; no explanation"
    if verdict == "explained":
        return f"{names or 'other values of the same model'}: error from {ratio}"
    leaves_little = is_close(error["fitted"]) and is_close(error["selection"])
    return _hypothesis(verdict, names, ratio, doubts if leaves_little else ())


def _hypothesis(verdict: Outcome, names: str, ratio: str, open_questions: Sequence[str]) -> str:
    """Return what is said of effects that are not proven; `open_questions` where they leave little but noise."""
    if names and open_questions:
        return f"{names} may account for what is missing, error from {ratio}, but is not proven: {open_questions[0]}"
    if verdict == "partly_explained":
        return f"{names} may account for a part: error from {ratio}; a hypothesis only"
    near = f"; nearest is {names}, which leaves too much" if names else ""
    return f"something is missing that no known effect explains (error {ratio}){near}"
