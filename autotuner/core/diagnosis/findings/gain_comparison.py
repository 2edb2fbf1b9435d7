"""Gains before and after, and their predicted responses on the process with its effects.

    response to the output  gains are those for the process as a controller sees it (`controller_view`)
    effects in the loop     calmer gains are reported too, where a step of the set point, after the effect, costs less
                            under them:  (mean |error| + cycle) over the step

Before and after are of the same design, which is a tuning's own where there is one: gains of different designs cannot
be compared.

Sizes of the steps are a share of the output's range in the record. Only effects between controller and process can be
predicted; disturbances and sensor effects do not change the gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.design import design, margins
from autotuner.core.design.requirements import requirements_for
from autotuner.core.design.simulation.closed_loop_setup import Installed, responses
from autotuner.core.diagnosis.findings.controller_view import controller_view
from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.design.gains import PidGains
    from autotuner.core.diagnosis.findings.result import FoundEffect
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

GOAL, CALMER = "balanced", "calm"
Choose = Callable[["ProcessModel", "FloatArray | None"], "PidGains"]
"""Gains for a process and the covariance of its parameters."""


@dataclass(frozen=True, slots=True)
class Design:
    """Design of the gains.

    Attributes
    ----------
    name : str
        The requested goal, such as ``balanced``.
    choose : callable
        Returns the gains for a process; may raise `InputError` and errors of arithmetic.
    calmer : Design or None
        What costs less where something sits in the loop; None where nothing else is to be reported.
    before : PidGains or None
        Gains that this design gave for the model without effects already, in a tuning; None: to be chosen.
    """

    name: str
    choose: Choose
    calmer: Design | None = None
    before: PidGains | None = None


def by_goal(goal: str, calmer: Design | None = None) -> Design:
    """Return the design of a goal, for the present model."""
    return Design(goal, lambda model, _: design(model, requirements_for(goal)).gains, calmer)


NOMINAL = by_goal(GOAL, by_goal(CALMER))
STEP = 0.3
"""Size of the steps: of the set point in gains times the output's swing, of the load in swings."""
NO_DESIGN = (AutotunerError, ValueError, ArithmeticError)
"""What a design raises for a model that it has no gains for."""
NO_SOLUTION = "the design has no solution for this process; identify it more exactly"
LASTS = 25.0
"""Length of a response, in sums of lags and dead time."""


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """A process, and the covariance of its parameters where known."""

    model: ProcessModel
    covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class _Loop:
    """The true process, with the effects at its input."""

    process: ProcessModel
    installed: Installed

    def comparison(self, goal: str, gains: PidGains, model: ProcessModel) -> dict[str, object]:
        """Return gains with their margins, and their response here."""
        own: dict[str, object] = {"goal": goal, "gains": gains.to_dict(), "margins": margins(model, gains).to_dict()}
        return {**own, "with_effects": self.outcome(gains)} if self.installed.foreseen else own

    def outcome(self, gains: PidGains) -> Mapping[str, object]:
        """Return the responses to a step of the set point and of the load with the effects in the loop."""
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
    slowest = r.a[1] if r.a[0] != 0.0 else 5.0 * max(process.D, r.a[2] / r.a[1])
    return LASTS * (slowest + process.D)


def both_gains(
    before: Known, after: Known, effects: Sequence[FoundEffect], dataset: Dataset, requested: Design = NOMINAL
) -> dict[str, object]:
    """Return the gains of the model without effects and of that with them, with margins and predicted outcome.

    Parameters
    ----------
    before, after : Known
        The model alone, and the process without the effects, with their covariances.
    effects : sequence of FoundEffect
        The effects.
    dataset : Dataset
        The recording.
    requested : Design
        Design of both.

    Returns
    -------
    dict
        ``before`` and ``after``, None without any; ``calmer`` where the calmer design costs less.
    """
    process, size = after.model, STEP * dataset.swing
    installed = Installed(
        dataset.data.interval_s,
        rest_output=dataset.output0,
        effects=tuple(effects),
        set_point_step=size * (process.K if math.isfinite(process.K) else 1.0),
        load_step=size,
    )
    loop = _Loop(process, installed)
    first = _gains(before, loop, requested, requested.before)
    if process == before.model and not effects:
        return {"before": first, "after": first}
    view = controller_view(process, after.covariance, effects)
    if view is None:
        return {"before": first, "after": None}
    answers = Known(view.model, view.covariance)
    last = _gains(answers, loop, requested)
    compared: dict[str, object] = {"before": first, "after": last}
    calm = _gains(answers, loop, requested.calmer) if requested.calmer and installed.foreseen else None
    return compared if calm is None or _cost(calm) >= _cost(last) else {**compared, "calmer": calm}


def _gains(known: Known, loop: _Loop, requested: Design, own: PidGains | None = None) -> dict[str, object] | None:
    """Return the gains of a design, which may be known as `own`, and their response; None without any."""
    try:
        return loop.comparison(requested.name, own or requested.choose(known.model, known.covariance), known.model)
    except NO_DESIGN:
        return None


def _cost(compared: Mapping[str, object] | None) -> float:
    outcome = None if compared is None else compared.get("with_effects")
    cost = outcome["cost"] if isinstance(outcome, dict) else math.inf
    return float(cost) if math.isfinite(cost) else math.inf


def missing_note(gains: Mapping[str, Any], effects: Sequence[FoundEffect]) -> list[str]:
    """Return the note on a process with effects for which there are no gains; none without effects."""
    if not effects or gains.get("before") is None or gains.get("after") is not None:
        return []
    names = " and ".join(effect.name for effect in effects)
    return [f"no gains after: none can be computed for a process with {names}; those before ignore it: watch that loop"]


def no_design_note(gains: Mapping[str, Any], known: Known, requested: Design) -> list[str]:
    """Return the note on a model that the design has no gains for, with its reason; none where there are some."""
    if gains.get("before") is not None or gains.get("after") is not None:
        return []
    try:
        requested.choose(known.model, known.covariance)
    except NO_DESIGN as error:
        return [f"no gains: {error if isinstance(error, AutotunerError) else NO_SOLUTION}"]
    return []


def calmer_note(gains: Mapping[str, Any]) -> list[str]:
    """Return the note on calmer gains, where they cost less with the effects in the loop."""
    if gains.get("calmer") is None:
        return []
    requested, calm = gains["after"], gains["calmer"]
    values = ", ".join(f"{name} {calm['gains'][name]:.4g}" for name in ("Kp", "Ti", "Td") if calm["gains"][name])
    costs = f", {calm['with_effects']['cost']:.2g} of the step instead of {_cost(requested):.2g}" if requested else ""
    effects = " and ".join(calm["with_effects"]["effects"])
    return [
        f"with {effects} in the loop, gains of the goal {calm['goal']} cost less{costs} (mean error, cycle): {values}"
    ]
