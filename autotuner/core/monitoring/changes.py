"""Results of monitoring a loop for a window of time.

Invariants: frozen values, JSON-ready by `to_dict`; `code` is stable and meant for programs; unknown values
are None, with the reason in words.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.core.jsonable import jsonable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design import PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.monitoring.oscillation import Oscillation

CODES: dict[str, str] = {
    "as_expected": "the loop behaves as its model and gains predict",
    "at_rest": "the loop rests within its noise, which shows neither change nor trouble",
    "disturbed": "the PV is disturbed; this record does not prove a change of the process",
    "retune_advised": "the process differs from that of the gains, or the loop oscillates",
    "valve_sticking": "the loop oscillates because its actuator has play or sticks",
}
"""Every code with its meaning."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected behaviour of the loop.

    Attributes
    ----------
    model : ProcessModel
        The process.
    interval95 : mapping of str to (float, float)
        How well its parameters are known; empty where that is not.
    gains : PidGains or None
        The controller in the device, where known.
    """

    model: ProcessModel
    interval95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    gains: PidGains | None = None


@dataclass(frozen=True, slots=True)
class Change:
    """A parameter of the process then and now.

    Attributes
    ----------
    expected, found : float
        In the parameter's unit.
    interval95 : (float, float)
        95 % interval of the estimate.
    """

    expected: float
    found: float
    interval95: tuple[float, float]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {"expected": self.expected, "found": jsonable(self.found), "interval95": jsonable(self.interval95)}


@dataclass(frozen=True, slots=True)
class Findings:
    """The judgement of a window of normal running.

    Attributes
    ----------
    code : str
        One of `CODES`.
    message, remedy : str
        The finding with its numbers, and the advice.
    error, noise : float
        Root mean square of measured minus expected PV, and standard deviation of the noise, PV units.
    oscillation : Oscillation or None
        That of the control error.
    process : mapping of str to Change
        Parameters found in this window; empty where it could not show them.
    Ms : (float or None, float or None) or None
        Largest sensitivity with the gains in the device on the process expected and on the one found, None where the
        loop is unstable on it; None as a whole where gains or process are not known.
    effects : mapping of str to (mapping of str to float)
        What a diagnosis of the window named, with its sizes.
    notes : tuple of str
        What this window could not show.
    """

    code: str
    message: str
    remedy: str
    error: float
    noise: float
    oscillation: Oscillation | None
    process: Mapping[str, Change]
    Ms: tuple[float | None, float | None] | None
    effects: Mapping[str, Mapping[str, float]]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "code": self.code,
            "message": self.message,
            "remedy": self.remedy,
            "error": jsonable(self.error),
            "noise": jsonable(self.noise),
            "oscillation": self.oscillation.to_dict() if self.oscillation else None,
            "process": {name: change.to_dict() for name, change in self.process.items()},
            "Ms": list(self.Ms) if self.Ms else None,
            "effects": jsonable(self.effects),
            "notes": list(self.notes),
        }
