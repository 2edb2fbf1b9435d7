"""Gains before and after, and what each would do on the process with the effects that were found.

    direction_gain         the larger of the two gains counts:  K <- K max(1, ratio)
    what sits in the loop  of the goals balanced and calm the one under which a step of the set point, behind the
                           effect, costs less:  (mean |error| + cycle) over the step

Sizes of the steps are a share of what the output did in the record. Only effects between controller and process can be
predicted; disturbances and those of the sensor leave the gains as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.process import model_from_dict, model_to_dict
from autotuner.core.tuning import design, margins
from autotuner.core.tuning.installed import Installed, responses
from autotuner.core.tuning.requirements import requirements_for
from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.case import Case
    from autotuner.core.diagnosis.result import FoundEffect
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.gains import PidGains

GOAL, CALMER = "balanced", "calm"
STEP = 0.3
"""Size of the steps: of the set point in gains times the output's swing, of the load in swings."""
LASTS = 25.0
"""Length of a response, in sums of lags and dead time."""


@dataclass(frozen=True, slots=True)
class _Loop:
    """The process as it is, with what sits before it."""

    process: ProcessModel
    installed: Installed

    def told(self, goal: str, gains: PidGains, model: ProcessModel) -> dict[str, object]:
        """Return gains with their margins, and what they do here."""
        own: dict[str, object] = {"goal": goal, "gains": gains.to_dict(), "margins": margins(model, gains).to_dict()}
        return {**own, "with_effects": self.outcome(gains)} if self.installed.foreseen else own

    def outcome(self, gains: PidGains) -> Mapping[str, object]:
        """Return what a step of the set point and one of the load come to behind the effects."""
        moved, loaded = responses(self.process, gains, self.installed, lasts_s(self.process))
        late = moved.pv[2 * moved.pv.size // 3 :]
        size = abs(self.installed.set_point_step)
        return {
            "effects": list(self.installed.foreseen),
            "set_point_step": self.installed.set_point_step,
            "overshoot": moved.overshoot,
            "settling_time_s": moved.settling_time_s,
            "set_point_iae": moved.iae,
            "cycle": float(np.ptp(late)) / size,
            "cost": float(np.mean(np.abs(moved.error)) + np.ptp(late)) / size,
            "load_step": self.installed.load_step,
            "load_iae": loaded.iae,
        }


def lasts_s(process: ProcessModel) -> float:
    """Return how long a predicted response has to be, s."""
    r = process.rational()
    slowest = r.a[1] if r.a[0] != 0.0 else 5.0 * max(process.D, r.a[1])
    return LASTS * (slowest + process.D)


def both_gains(
    before: ProcessModel, after: ProcessModel, effects: Sequence[FoundEffect], case: Case
) -> dict[str, object]:
    """Return the gains of the model without effects and of that with them, with margins and predicted outcome.

    Parameters
    ----------
    before, after : ProcessModel
        The model alone, and the process beside the effects.
    effects : sequence of FoundEffect
        What was found.
    case : Case
        The recording.
    """
    size = STEP * case.swing
    installed = Installed(
        case.data.interval_s,
        rest_output=case.output0,
        effects=tuple(effects),
        set_point_step=size * (after.K if math.isfinite(after.K) else 1.0),
        load_step=size,
    )
    loop = _Loop(after, installed)
    first = _gains(before, loop, (GOAL,))
    if after == before and not effects:
        return {"before": first, "after": first}
    ratio = max((e.parameters.get("ratio", 1.0) for e in effects if e.name == "direction_gain"), default=1.0)
    stronger = model_from_dict({**model_to_dict(after), "K": after.K * max(1.0, ratio)}) if ratio > 1.0 else after
    goals = (GOAL, CALMER) if installed.foreseen else (GOAL,)
    return {"before": first, "after": _gains(stronger, loop, goals)}


def _gains(model: ProcessModel, loop: _Loop, goals: Sequence[str]) -> dict[str, object] | None:
    """Return the gains of the goal that costs least behind the effects; None where there are none."""
    found = []
    for goal in goals:
        try:
            found.append(loop.told(goal, design(model, requirements_for(goal)).gains, model))
        except (AutotunerError, ValueError, ArithmeticError):
            continue
    return min(found, key=_cost, default=None)


def _cost(told: Mapping[str, object]) -> float:
    outcome = told.get("with_effects")
    cost = outcome["cost"] if isinstance(outcome, dict) else 0.0
    return float(cost) if math.isfinite(cost) else math.inf
