"""From what the search found to what the reader is told."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.judge import DRIVEN, VISIBLE, driven, noise_of
from autotuner.core.diagnosis.result import Diagnosis, FoundEffect, Misfit, Outcome, Traces
from autotuner.core.process import model_to_dict
from autotuner.core.tuning import tune
from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.diagnose import Trace
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

ABOUT_AS_WELL = 8.0
"""Difference of the criterion under which two explanations count as equally good."""


def reported(bench: Bench, found: Trace, model: ProcessModel | None, recording: Recording) -> Diagnosis:
    """Return the diagnosis."""
    case = bench.case
    base, chosen = found.base, found.chosen
    declared = model if model is not None else base.process()
    noise = noise_of(case)
    effects = _effects(bench, found)
    verdict: Outcome = "explained" if effects else _without_effects(bench, base)
    rows = np.arange(case.data.t.size)
    error = {
        "fitted": Misfit(base.rms, chosen.rms, noise),
        "held_out": Misfit(_rms(bench.held_out_residual(base)), _rms(bench.held_out_residual(chosen)), noise),
    }
    traces = Traces(
        case.data.t,
        case.data.held.levels[np.searchsorted(case.data.held.times, case.data.t, side="right") - 1] + case.output0,
        case.data.pv + case.pv0,
        base.simulated(rows) + case.pv0,
        chosen.simulated(rows) + case.pv0,
        case.fitted_until_s,
    )
    before, after = base.process(), chosen.process()
    return Diagnosis(
        verdict,
        effects,
        None,
        error,
        {"before": model_to_dict(declared), "after": model_to_dict(after)},
        {"before": _gains(before), "after": _gains(after)},
        recording.notes,
        traces=traces,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _gains(model: ProcessModel) -> dict[str, object] | None:
    try:
        return tune(model).to_dict()
    except AutotunerError:
        return None


def _without_effects(bench: Bench, base: Fitted) -> Outcome:
    case = bench.case
    if base.rms > VISIBLE * noise_of(case) and driven(case, base.residual, base.problem.rows) > DRIVEN:
        return "unexplained"
    return "adequate"


def _effects(bench: Bench, found: Trace) -> tuple[FoundEffect, ...]:
    chosen = found.chosen
    result = []
    for effect, sizes in zip(chosen.problem.effects, chosen.sizes(), strict=True):
        others = tuple(e.name for e in chosen.problem.effects if e is not effect)
        rivals = _rivals(bench, found, others)
        alike = tuple(n for n, above in rivals.items() if n != effect.name and above < ABOUT_AS_WELL)
        weight = sum(math.exp(-0.5 * max(a, 0.0)) for a in rivals.values())
        result.append(
            FoundEffect(
                effect.name, effect.place.value, sizes, {}, min(1.0 / max(weight, 1.0), 0.999), alike, effect.form
            )
        )
    return tuple(result)


def _rivals(bench: Bench, found: Trace, others: tuple[str, ...]) -> dict[str, float]:
    """Return, by name, how far each explanation with the same other effects lies above the chosen one."""
    inflated = bench.colour(found.chosen)
    reference = bench.criterion(found.chosen, inflated)
    rivals: dict[str, float] = {}
    for candidate in (*found.pool, found.chosen):
        names = list(candidate.names)
        if len(names) != len(others) + 1:
            continue
        for name in others:
            if name in names:
                names.remove(name)
        if len(names) != 1:
            continue
        above = bench.criterion(candidate, inflated) - reference
        rivals[names[0]] = min(above, rivals.get(names[0], math.inf))
    return rivals
