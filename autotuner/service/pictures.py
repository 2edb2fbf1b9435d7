"""What a worker process computes for the page: curves, and the gains of every goal with what they will do.

Rule of this file: it is imported by every worker, so it imports no web framework.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.tuning import GOALS
from autotuner.errors import InputError
from autotuner.reports.curves import fit_curves, loop_curves
from autotuner.runtime.analysis import gains_for

if TYPE_CHECKING:
    from autotuner.core.identification import Identification
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Tuning as Gains


def fit_of(recording: Recording, model: ProcessModel | None, most: int) -> dict[str, object]:
    """Return the curves of a recording; see `autotuner.reports.curves.fit_curves`."""
    return fit_curves(recording, model, most)


def choices_of(identification: Identification, rule: str | None) -> list[dict[str, object]]:
    """Return the gains of every goal, and of a rule where one is given, with their predicted responses, JSON-ready."""
    found = {goal: _gains(identification, goal, None) for goal in GOALS}
    if rule is not None:
        found[rule] = _gains(identification, "balanced", rule)
    usable = {name: gains for name, gains in found.items() if gains is not None}
    assert identification.model is not None  # noqa: S101 - the caller has checked it
    curves = loop_curves(identification.model, [gains.gains for gains in usable.values()])
    return [
        {"name": name, **_told(gains), "responses": responses}
        for (name, gains), responses in zip(usable.items(), curves, strict=True)
    ]


def _gains(identification: Identification, goal: str, rule: str | None) -> Gains | None:
    """Return the gains; None for a process that has none of this kind."""
    try:
        return gains_for(identification, goal, rule)
    except InputError:
        return None


def _told(gains: Gains) -> dict[str, object]:
    told = gains.to_dict()
    return {name: value for name, value in told.items() if name != "alternatives"}
