"""Advice on the parts of a PID controller that a process needs, and the cost of a controller with fewer parts.

    cost of PI  = load error of the best PI controller / that of the best PID controller, both as robust
    share of P  = 1/|1 + K Kp|, the share of a lasting load's effect that a P controller leaves

Both are of the model alone, inside the balanced limits. Derivative action is advised where its benefit exceeds its
noise. A dead-time compensator is never advised: as robust as a PID controller, a Smith predictor leaves 0.78 times its
error at best (`benchmarks/accuracy/tuning/dead_time_compensation.py`).

`K` PV per output, `Kp` output/PV.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from autotuner.core.design.optimisation.robust import design
from autotuner.core.design.requirements import Controller, Requirements
from autotuner.core.model.process import model_from_dict
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.process import ProcessModel

WORTH_IT = 1.25
"""Load error of PI over that of PID from which a derivative, which passes the PV's noise on, is advised."""
VISIBLE_FILTER = 0.2
"""Filter time, in derivative times, from which the advice names the measurement filter."""


@dataclass(frozen=True, slots=True)
class ControllerAdvice:
    """Which controller a process needs.

    Attributes
    ----------
    controller : str
        The advised parts, ``PI`` or ``PID``.
    PI : float
        Load error of the best PI controller, by that of the best PID controller.
    P : float or None
        Share of a load's effect that the best P controller leaves for good; None for a process without a rest.
    filtered : bool
        Whether a PID controller needs a measurement filter that is slow compared with its derivative.
    """

    controller: str
    PI: float
    P: float | None
    filtered: bool

    def __str__(self) -> str:
        excess = 100.0 * (self.PI - 1.0)
        offset = (
            "P leaves a lasting error" if self.P is None else f"P leaves {100.0 * self.P:.0f} % of a load uncorrected"
        )
        if self.controller == Controller.PI:
            return (
                f"PI: a derivative would lower the error after a load step by {100.0 - 100.0 / self.PI:.0f} %; {offset}"
            )
        name = "PID with a measurement filter" if self.filtered else "PID"
        return f"{name}: with PI the error after a load step is {excess:.0f} % larger; {offset}"

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        costs = {"PI": self.PI, "P": self.P}
        return {"controller": self.controller, "filtered": self.filtered, "costs": costs, "text": str(self)}


def controller_advice(model: ProcessModel) -> ControllerAdvice | None:
    """Return the advice for a process; None where a controller without some parts cannot keep the usual limits.

    Parameters
    ----------
    model : ProcessModel
        The process with the delay of the controller's sampling.
    """
    return _advised(model.structure, tuple(model.parameters().items()))


@lru_cache(maxsize=64)
def _advised(structure: str, parameters: tuple[tuple[str, float], ...]) -> ControllerAdvice | None:
    """Return the advice by plain values: a result is shown more than once, and its gains for each goal."""
    model = model_from_dict(dict(parameters), structure)
    try:
        P, PI, PID = (design(model, Requirements(controller=controller)) for controller in Controller)
    except InputError:
        return None
    if max(found.requirements.Ms for found in (PI, PID)) > Requirements().Ms:
        return None
    cost, gains = max(1.0, PI.iae / PID.iae), PID.gains
    needed = Controller.PID if cost > WORTH_IT else Controller.PI
    return ControllerAdvice(
        needed.value, cost, _lasting_share(model, P.gains), gains.Tf > VISIBLE_FILTER * gains.Td > 0.0
    )


def _lasting_share(model: ProcessModel, gains: PidGains) -> float | None:
    """Return the share of a load's lasting effect that proportional action leaves; None of a process without a rest."""
    if model.rational().a[0] <= 0.0:
        return None
    return 1.0 / abs(1.0 + model.K * gains.Kp)
