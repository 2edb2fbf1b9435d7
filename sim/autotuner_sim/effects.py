"""Physics around a plant that a linear model lacks, as small objects that `SteppedPlant` takes in lists.

    actuators   command -> position        Backlash, Stiction, Saturation, RateLimit, OutputQuantisation
    loads       added to the plant's input LoadStep
    offsets     added to the PV            Drift
    sensors     PV -> reading              Noise, Quantisation

An effect of one's own needs no more than its protocol. The objects keep their state (where the valve stands) and are
copied by the plant that takes them, so that one list may serve many plants.

Commands, positions and loads in output units, PV and readings in PV units, times in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

DRAWN = 256
"""Numbers that a noise draws at once."""


class Actuator(Protocol):
    """What lies between the commanded output and the plant."""

    moves_by_itself: ClassVar[bool]
    """Whether the position changes between commands; the plant then needs an `actuator_scan_s`."""

    def rest(self, output: float) -> None:
        """Stand still at `output` from the beginning of time."""

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position for the command, `elapsed_s` after the last call."""


class Load(Protocol):
    """A disturbance at the plant's input that changes in steps."""

    def load(self, t: float) -> float:
        """Return what is added to the plant's input from `t` on."""

    def next_change_s(self, after: float) -> float:
        """Return the first time later than `after` at which it changes, infinite if none."""


class Offset(Protocol):
    """A disturbance of the PV that is known at every time."""

    def offset(self, t: float) -> float:
        """Return what is added to the PV at `t`."""


class Sensor(Protocol):
    """What lies between the PV and its reading."""

    def read(self, pv: float, t: float) -> float:
        """Return the reading of `pv` taken at `t`."""


def _require_positive(effect: object, name: str, value: float) -> None:
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(
            f"{type(effect).__name__}.{name} must be positive (got {value!r}). Leave the effect out to have none."
        )


@dataclass(slots=True)
class Backlash:
    """A dead-band of full width `width`: the position follows only once the play is taken up."""

    moves_by_itself: ClassVar[bool] = False
    width: float
    _position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _require_positive(self, "width", self.width)

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
        _require_positive(self, "band", self.band)

    def rest(self, output: float) -> None:
        """Stick at `output`."""
        self._position = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        if abs(command - self._position) > self.band:
            self._position = command
        return self._position


@dataclass(slots=True)
class Saturation:
    """A position that cannot leave `low` to `high`, whatever is commanded."""

    moves_by_itself: ClassVar[bool] = False
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"Saturation.high must exceed low = {self.low} (got {self.high}). Give two distinct ends.")

    def rest(self, output: float) -> None:
        """Do nothing: it has no memory."""

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return min(max(command, self.low), self.high)


@dataclass(slots=True)
class RateLimit:
    """A position that moves by at most `rate_per_s`, in the steps of the plant's `actuator_scan_s`."""

    moves_by_itself: ClassVar[bool] = True
    rate_per_s: float
    _position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _require_positive(self, "rate_per_s", self.rate_per_s)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._position = output

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position for the command, `elapsed_s` after the last call."""
        travel = self.rate_per_s * elapsed_s
        self._position = min(max(command, self._position - travel), self._position + travel)
        return self._position


@dataclass(slots=True)
class OutputQuantisation:
    """A position that knows only multiples of `step`, counted from rest."""

    moves_by_itself: ClassVar[bool] = False
    step: float
    _origin: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        _require_positive(self, "step", self.step)

    def rest(self, output: float) -> None:
        """Put `output` on the grid."""
        self._origin = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return self._origin + self.step * round((command - self._origin) / self.step)


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load of `size` that stays from `at_s` on."""

    at_s: float
    size: float

    def load(self, t: float) -> float:
        """Return what is added to the plant's input from `t` on."""
        return self.size if t >= self.at_s else 0.0

    def next_change_s(self, after: float) -> float:
        """Return the time of the step if it is still to come."""
        return self.at_s if after < self.at_s else math.inf


@dataclass(frozen=True, slots=True)
class Drift:
    """A PV that wanders off by `rate_per_s` from `from_s` on."""

    rate_per_s: float
    from_s: float = 0.0

    def offset(self, t: float) -> float:
        """Return what is added to the PV at `t`."""
        return self.rate_per_s * max(t - self.from_s, 0.0)


class Noise:
    """White Gaussian noise of standard deviation `sigma`; the same seed gives the same readings."""

    def __init__(self, sigma: float, seed: int = 0) -> None:
        _require_positive(self, "sigma", sigma)
        self._sigma = sigma
        self._random = np.random.default_rng(seed)
        self._drawn: list[float] = []

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the reading of `pv`."""
        if not self._drawn:  # many at once cost little more than one, and are the same numbers
            self._drawn = self._random.standard_normal(DRAWN)[::-1].tolist()
        return pv + self._sigma * self._drawn.pop()


@dataclass(frozen=True, slots=True)
class Quantisation:
    """A reading that knows only multiples of `step`, as a converter or a register of integers does."""

    step: float

    def __post_init__(self) -> None:
        _require_positive(self, "step", self.step)

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the reading of `pv`."""
        return self.step * round(pv / self.step)
