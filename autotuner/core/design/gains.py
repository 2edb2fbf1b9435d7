"""The gains that every other form is converted from and to.

    u = Kp (b r - yf + (1/Ti) int(r - yf) - Td dyf/dt),   yf = PV / (1 + s Tf + s^2 Tf^2/2)

A device may filter its derivative alone, by the first order `1/(1 + s Td/N)`; its filter `Tf` is then usually 0.

`Kp` output/PV, `Ti`, `Td`, `Tf` s, `b`, `N` dimensionless. The ideal (ISA) form with the set-point weight and
second-order measurement filter of Astrom and Hagglund, Advanced PID Control, 2006, eqs. 3.15 and 3.21.

Invariants: `Ti` infinite means no integral action; the sign of `Kp` is the action of the controller (positive:
reverse acting, a rising PV lowers the output); gains that cannot exist cannot be made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.model.arrays import ComplexArray, FloatArray


class Action(StrEnum):
    """Action of the controller: direction of the output for a rising PV."""

    REVERSE = "reverse"
    DIRECT = "direct"

    def to_dict(self) -> dict[str, str]:
        """Return the JSON field of the action; `action` is its name of earlier versions."""
        return {"controller_action": self.value, "action": self.value}

    @property
    def words(self) -> str:
        """The action of the process and that of the controller, which are opposite."""
        process = Action.DIRECT if self is Action.REVERSE else Action.REVERSE
        return f"process {process.value}, controller {self.value} acting"


@dataclass(frozen=True, slots=True)
class PidGains:
    """A PID controller in the ideal form.

    Attributes
    ----------
    Kp : float
        Proportional gain, output/PV; negative for a direct-acting controller.
    Ti : float
        Integral time, s; infinite for no integral action.
    Td : float
        Derivative time, s.
    Tf : float
        Time constant of the second-order measurement filter, s.
    b : float
        Weight of the set point in the proportional part, usually 0 to 1.
    N : float
        Ratio of `Td` to the time constant of a first-order filter of the derivative alone; infinite for no such filter.

    Raises
    ------
    InputError
        `Kp` zero or not finite, `Ti` or `N` not positive, `Td` or `Tf` negative or not finite, `b` not finite.
    """

    Kp: float
    Ti: float = math.inf
    Td: float = 0.0
    Tf: float = 0.0
    b: float = 1.0
    N: float = math.inf

    def __post_init__(self) -> None:
        checks = {
            "Kp": (math.isfinite(self.Kp) and self.Kp != 0.0, "must be a finite number other than zero"),
            "Ti": (self.Ti > 0.0, "must be positive; infinite means no integral action"),
            "Td": (0.0 <= self.Td < math.inf, "must be a finite number that is not negative"),
            "Tf": (0.0 <= self.Tf < math.inf, "must be a finite number that is not negative"),
            "b": (math.isfinite(self.b), "must be a finite number"),
            "N": (self.N > 0.0, "must be positive; infinite means no filter of the derivative"),
        }
        for name, (holds, what) in checks.items():
            if not holds:
                raise InputError(what, field=f"gains.{name}", value=getattr(self, name), remedy=f"Correct {name}.")

    @property
    def controller(self) -> str:
        """``P``, ``PI``, ``PD`` or ``PID``."""
        return "P" + ("I" if math.isfinite(self.Ti) else "") + ("D" if self.Td > 0.0 else "")

    @property
    def words(self) -> str:
        """The gains for people, such as ``Kp 1.527, Ti 7.079 s, Td 0.4891 s``."""
        integral = f"Ti {self.Ti:.4g} s" if math.isfinite(self.Ti) else "no Ti"
        return f"Kp {self.Kp:.4g}, {integral}, Td {self.Td:.4g} s"

    @property
    def action(self) -> Action:
        """The controller action, from the sign of `Kp`."""
        return Action.REVERSE if self.Kp > 0.0 else Action.DIRECT

    @property
    def Ki(self) -> float:
        """Integral gain `Kp / Ti`, output/(PV s)."""
        return self.Kp / self.Ti

    @property
    def Kd(self) -> float:
        """Derivative gain `Kp Td`, output s/PV."""
        return self.Kp * self.Td

    @property
    def derivative_filter_s(self) -> float:
        """Time constant `Td / N` of the derivative's own filter, s; 0 for none."""
        return self.Td / self.N

    def to_dict(self) -> dict[str, float | str | None]:
        """Return JSON-ready values; `Ti` is null without integral action, `N` without a filter of the derivative."""
        return {
            "controller": self.controller,
            "Kp": self.Kp,
            "Ti": self.Ti if math.isfinite(self.Ti) else None,
            "Td": self.Td,
            "Tf": self.Tf,
            "b": self.b,
            "N": self.N if math.isfinite(self.N) else None,
        }


def gains_from_dict(values: Mapping[str, object]) -> PidGains:
    """Create gains from the result of `PidGains.to_dict`.

    Raises
    ------
    InputError
        A value is missing, surplus, or not a number; names the field.
    """
    names = ("Kp", "Ti", "Td", "Tf", "b", "N")
    given = {name: value for name, value in values.items() if name != "controller"}
    if surplus := sorted(set(given) - set(names)):
        raise InputError(
            "is not a gain", field=f"gains.{surplus[0]}", value=given[surplus[0]], remedy=f"Use {', '.join(names)}."
        )
    for name in ("Ti", "N"):
        if given.get(name, 0.0) is None:
            given[name] = math.inf
    for name, value in [("Kp", given.get("Kp")), *given.items()]:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError("must be a number", field=f"gains.{name}", value=value, remedy=f"Give {name} as a number.")
    return PidGains(**{name: float(value) for name, value in given.items()})  # type: ignore[arg-type]


def controller_response(gains: PidGains, frequency_rad_s: FloatArray) -> ComplexArray:
    """Return `C(jw) F(jw)`: from PV to output with the sign turned, measurement filter included.

    Parameters
    ----------
    gains : PidGains
        The controller.
    frequency_rad_s : array of float, any shape
        Angular frequencies other than zero, rad/s.
    """
    s = np.asarray(1j * frequency_rad_s, dtype=np.complex128)
    derivative = gains.Kd * s
    if gains.derivative_filter_s:
        derivative /= 1.0 + s * gains.derivative_filter_s
    response: ComplexArray = gains.Kp + gains.Ki / s + derivative
    if gains.Tf:
        response /= 1.0 + s * gains.Tf * (1.0 + s * gains.Tf / 2.0)
    return response
