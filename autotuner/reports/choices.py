"""The gains of every goal side by side, with what they will do.

Rule of this file: a goal for which a process has no gains is left out, never guessed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.tuning import GOALS, tune
from autotuner.errors import InputError
from autotuner.reports.curves import loop_curves

if TYPE_CHECKING:
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning import Tuning as Gains


def choices_of(model: ProcessModel, rule: str | None) -> list[dict[str, object]]:
    """Return the gains of every goal, and of a rule where one is given, with their predicted responses, JSON-ready."""
    found = {goal: _gains(model, goal, None) for goal in GOALS}
    if rule is not None:
        found[rule] = _gains(model, "balanced", rule)
    usable = {name: gains for name, gains in found.items() if gains is not None}
    curves = loop_curves(model, [gains.gains for gains in usable.values()])
    return [
        {"name": name, **_told(gains), "responses": responses}
        for (name, gains), responses in zip(usable.items(), curves, strict=True)
    ]


def _gains(model: ProcessModel, goal: str, rule: str | None) -> Gains | None:
    """Return the gains; None for a process that has none of this kind."""
    try:
        return tune(model, goal=goal, rule=rule)
    except InputError:
        return None


def _told(gains: Gains) -> dict[str, object]:
    told = gains.to_dict()
    return {name: value for name, value in told.items() if name != "alternatives"}
