"""Valve friction: dead-band, stiction in the data-driven forms of the literature, position-dependent dead-band.

All take the command `u` and hold the stem `x`, output units. `S` is dead-band plus stick band, `J` the slip jump;
`f_s` static and `f_d` kinetic friction, with `S = f_s + f_d` and `J = f_s - f_d`. One call is one scan of the valve: a
command that has not changed lets the stem stop.

    Stiction   A. Stenman, F. Gustafsson, K. Forsman, Int. J. Adapt. Control Signal Process. 17 (2003) 625
    He         Q.P. He, J. Wang, M. Pottmann, S.J. Qin, Ind. Eng. Chem. Res. 46 (2007) 4549
    Choudhury  M.A.A.S. Choudhury, N.F. Thornhill, S.L. Shah, Control Eng. Practice 13 (2005) 641
    Kano       M. Kano, H. Maruta, H. Kugemoto, K. Shimizu, IFAC DYCOPS (2004)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from autotuner_sim.effects.protocols import require_positive


@dataclass(slots=True)
class Backlash:
    """A dead-band of full width `width`: the position follows only once the play is crossed."""

    moves_by_itself: ClassVar[bool] = False
    width: float
    _position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        require_positive(self, "width", self.width)

    def rest(self, output: float) -> None:
        """Stand still at `output`, in the middle of the play."""
        self._position = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        play = self.width / 2.0
        self._position = min(max(self._position, command - play), command + play)
        return self._position


@dataclass(slots=True)
class Stiction:
    """A valve that sticks until the command is `band` away, then jumps to it (Stenman, Gustafsson, Forsman, 2003)."""

    moves_by_itself: ClassVar[bool] = False
    band: float
    _position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        require_positive(self, "band", self.band)

    def rest(self, output: float) -> None:
        """Stick at `output`."""
        self._position = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        if abs(command - self._position) > self.band:
            self._position = command
        return self._position


def _check(name: str, **values: float) -> None:
    for key, value in values.items():
        if not (value >= 0.0 and math.isfinite(value)):
            raise ValueError(f"{name}.{key} must not be negative (got {value!r}). Give a friction in output units.")


@dataclass(slots=True)
class HeStiction:
    """The stem moves when the gathered force exceeds `static`, and then stops `kinetic` short of the command."""

    moves_by_itself: ClassVar[bool] = False
    static: float
    kinetic: float
    _x: float = field(default=0.0, init=False)
    _u: float = field(default=0.0, init=False)
    _left: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _check("HeStiction", static=self.static, kinetic=self.kinetic)

    def rest(self, output: float) -> None:
        """Stick at `output` without force."""
        self._x = self._u = output
        self._left = 0.0

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the stem for the command."""
        force = self._left + command - self._u
        self._u = command
        if abs(force) > self.static:
            self._left = math.copysign(self.kinetic, force)
            self._x = command - self._left
        else:
            self._left = force
        return self._x


@dataclass(slots=True)
class KanoStiction:
    """The stem stops when the command stops or turns; it slips after `J` the same way, after `S` the other way."""

    moves_by_itself: ClassVar[bool] = False
    S: float
    J: float
    _x: float = field(default=0.0, init=False)
    _u: float = field(default=0.0, init=False)
    _stopped_at: float = field(default=0.0, init=False)
    _way: float = field(default=0.0, init=False)
    _last_move: float = field(default=0.0, init=False)
    _stopped: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        _check("KanoStiction", S=self.S, J=self.J)

    def rest(self, output: float) -> None:
        """Stick at `output`, in the middle of its band."""
        self._x = self._u = self._stopped_at = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the stem for the command."""
        move = command - self._u
        if not self._stopped and (move == 0.0 or move * self._last_move < 0.0):
            self._stopped, self._stopped_at = True, self._u
        self._u = command
        self._last_move = move or self._last_move
        if not self._stopped or self._slips(command - self._stopped_at):
            self._x = command - self._way * (self.S - self.J) / 2.0
        return self._x

    def _slips(self, beyond: float) -> bool:
        band = (self.S + self.J) / 2.0 if self._way == 0.0 else (self.J if beyond * self._way > 0.0 else self.S)
        if abs(beyond) <= band:
            return False
        self._way, self._stopped = math.copysign(1.0, beyond), False
        return True


@dataclass(slots=True)
class ChoudhuryStiction:
    """As drawn in the input-output plane: through the dead-band and the stick band, a jump, then along the line.

    A constant command stops the stem too; it continues in the same direction after the stick band `J`.
    """

    moves_by_itself: ClassVar[bool] = False
    S: float
    J: float
    _x: float = field(default=0.0, init=False)
    _u: float = field(default=0.0, init=False)
    _stuck_at: float = field(default=0.0, init=False)
    _way: float = field(default=0.0, init=False)
    _band: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _check("ChoudhuryStiction", S=self.S, J=self.J)

    def rest(self, output: float) -> None:
        """Stick at `output`, in the middle of its band."""
        self._x = self._u = self._stuck_at = output
        self._band = self.S / 2.0

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the stem for the command."""
        move = command - self._u
        if move == 0.0:
            if self._band == 0.0:
                self._stuck_at, self._band = command, self.J
            return self._x
        direction = math.copysign(1.0, move)
        if self._way not in {direction, 0.0}:
            self._stuck_at, self._band = self._u, self.S
        self._way, self._u = direction, command
        if abs(command - self._stuck_at) > self._band:
            self._band = 0.0
            self._x = command - direction * (self.S - self.J) / 2.0
        return self._x


@dataclass(slots=True)
class PositionBacklash:
    """A dead-band whose width depends on the position: `width (1 + slope (u - u_rest))`, never negative."""

    moves_by_itself: ClassVar[bool] = False
    width: float
    slope: float
    _x: float = field(default=0.0, init=False)
    _origin: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _check("PositionBacklash", width=self.width)

    def rest(self, output: float) -> None:
        """Stand still at `output`, in the middle of the play."""
        self._x = self._origin = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        play = max(self.width * (1.0 + self.slope * (command - self._origin)), 0.0) / 2.0
        self._x = min(max(self._x, command - play), command + play)
        return self._x
