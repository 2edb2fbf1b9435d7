"""From a recording, and a model if there is one, to a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.base import Base, base_of
from autotuner.core.diagnosis.bench import bench_of
from autotuner.core.diagnosis.case import case_of
from autotuner.core.diagnosis.catalogue import catalogue
from autotuner.core.diagnosis.judge import VISIBLE, is_believed, noise_of, weigh
from autotuner.core.diagnosis.report import reported
from autotuner.core.diagnosis.search import extend, without
from autotuner.core.identification import advice
from autotuner.core.identification.condense import condensed
from autotuner.core.signals.feedback import process_sign
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.diagnosis.result import Diagnosis
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

MOST_SAMPLES = 6000
MOST_EFFECTS = 3
BEAM = 3
"""Explanations that are carried on to a further effect."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """What the search found.

    Attributes
    ----------
    base : Fitted
        The process alone.
    chosen : Fitted
        The process with the effects that are believed; the base when there are none.
    pool : tuple of Fitted
        All that was fitted on all samples.
    """

    base: Fitted
    chosen: Fitted
    pool: tuple[Fitted, ...]


def diagnose(recording: Recording, model: ProcessModel | None = None) -> Diagnosis:
    """Say whether a model lacks anything that a recording shows; if so what, how big, how sure, and what it changes.

    Parameters
    ----------
    recording : Recording
        Output and PV: a tuning's own record, a step test, a historian's CSV.
    model : ProcessModel, optional
        The declared model; without it the process is identified from the same record.

    Returns
    -------
    Diagnosis
        See there.

    Raises
    ------
    RecordingError
        A record that cannot show a process, with the reason and a remedy.
    """
    if verdict := advice.unusable(recording):
        raise RecordingError(verdict.message, field="recording", remedy=verdict.remedy)
    case = case_of(condensed(recording, MOST_SAMPLES))
    bench = bench_of(case)
    base = base_of(bench, ("offset",), process_sign(recording))
    if base is None:
        raise RecordingError(
            "no process comes near it", field="recording", remedy="Check that output and PV belong together."
        )
    found = trace(bench, base)
    return reported(bench, found, model, recording)


def trace(bench: Bench, base: Base) -> Trace:
    """Search for effects until none is believed any more."""
    case = bench.case
    best = base.best
    rows = np.arange(case.data.t.size)
    effects = catalogue(case, case.data.pv - best.simulated(rows))
    pool: list[Fitted] = []
    beam: list[Fitted] = list(base.origins)
    for depth in range(MOST_EFFECTS):
        if best.rms < 1.02 * noise_of(case) and depth > 0:
            break
        found = extend(bench, beam, effects)
        pool += found
        if not found:
            break
        following = bench.best(found)
        if _accepted(bench, best, following):
            best = following
        elif depth > 0 or best.rms < VISIBLE * noise_of(case):
            break
        beam = _distinct(found)[:BEAM]
    best = dropped_back(bench, best) if best.problem.effects else best
    return Trace(base.best, best, tuple(pool))


def _accepted(bench: Bench, before: Fitted, after: Fitted) -> bool:
    known = set(before.names)
    new = [e for e in after.problem.effects if e.name not in known]
    seen = any(not e.unseen_after for e in new)
    return is_believed(weigh(bench, before, after), first=not before.problem.effects, seen_held_out=seen)


def _distinct(found: Sequence[Fitted]) -> list[Fitted]:
    """Return the best of each set of names."""
    kept: dict[tuple[str, ...], Fitted] = {}
    for candidate in found:
        kept.setdefault(tuple(sorted(candidate.names)), candidate)
    return list(kept.values())


def dropped_back(bench: Bench, best: Fitted) -> Fitted:
    """Leave out every effect that is no longer needed."""
    if len(best.problem.effects) < 2:
        return best
    for effect in best.problem.effects:
        simpler = without(bench, best, effect)
        evidence = weigh(bench, simpler, best)
        if not is_believed(evidence, first=False, seen_held_out=not effect.unseen_after):
            return dropped_back(bench, simpler)
    return best
