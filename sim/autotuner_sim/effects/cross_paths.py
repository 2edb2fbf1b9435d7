"""A path from the output of one loop to the PV of another one, for two loops that disturb each other.

    Sends    sits at the actuators of the loop whose output moves the other PV
    Hears    is added to that PV: K e^{-Ds} / ((T1 s + 1)(T2 s + 1)) (u - output0)

Both name the same wire, a number; two ends created one after the other in one process are connected. A loop that
advances to a time earlier than the sender's present time receives what was sent until then.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar
from weakref import WeakValueDictionary

from autotuner_sim.plants.linear import SopdtOverdamped

if TYPE_CHECKING:
    from autotuner_sim.plants.motion import Motion, State


class Wire:
    """Outputs that were sent: times, s, and positions, output units, in order of time."""

    def __init__(self) -> None:
        self.t: list[float] = []
        self.position: list[float] = []


_WAITING: WeakValueDictionary[tuple[float, str], Wire] = WeakValueDictionary()
"""Wires with one end, by their number and the end that is missing."""
_OTHER = {"sends": "hears", "hears": "sends"}


def _joined(number: float, end: str) -> Wire:
    """Return the wire that waits for this end, or a new one."""
    wire = _WAITING.pop((number, end), None)
    if wire is None:
        wire = _WAITING[number, _OTHER[end]] = Wire()
    return wire


@dataclass(eq=False, slots=True)
class Sends:
    """Puts every position of an actuator on a wire."""

    moves_by_itself: ClassVar[bool] = False
    wire: float
    _sent: Wire = field(init=False)
    _t: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._sent = _joined(self.wire, "sends")

    def __deepcopy__(self, _memo: dict[int, object]) -> Sends:
        return self

    def rest(self, output: float) -> None:
        """Stand still at `output` from the beginning of time."""

    def act(self, command: float, elapsed_s: float) -> float:
        """Pass the command on, and put it on the wire."""
        self._t += elapsed_s
        self._sent.t.append(self._t)
        self._sent.position.append(command)
        return command


@dataclass(eq=False, slots=True)
class Hears:
    """Contribution of a wire to the PV."""

    wire: float
    K: float
    T1: float
    T2: float = 0.0
    D: float = 0.0
    output0: float = 0.0
    _sent: Wire = field(init=False)
    _motion: Motion = field(init=False)
    _state: State = field(init=False)
    _seen: int = field(default=0, init=False)
    _t: float = field(default=0.0, init=False)
    _input: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._sent = _joined(self.wire, "hears")
        self._motion = SopdtOverdamped(self.K, self.T1, self.T2, self.D).motion()
        self._state = self._motion.rest

    def __deepcopy__(self, _memo: dict[int, object]) -> Hears:
        return self

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        sent = self._sent
        while self._seen < len(sent.t) and sent.t[self._seen] + self.D <= t:
            self._move(max(sent.t[self._seen] + self.D, self._t))
            self._input = sent.position[self._seen] - self.output0
            self._seen += 1
        self._move(max(t, self._t))
        return self._motion.output(self._state)

    def _move(self, t: float) -> None:
        self._state = self._motion.move(self._state, self._input, t - self._t)
        self._t = t
