"""A relay, and what a relay test recorded.

    output = high   from the moment at which pv < reference - hysteresis
    output = low    from the moment at which pv > reference + hysteresis

(the other way round for a reverse plant). Times s, levels in output units and PV as deviations from rest, which is
where the plant is before `t = 0`.

Rules of this file: a run knows the plant's state at each change of its input, so everything asked of it is exact.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner_sim.crossing import extremes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from autotuner_sim.motion import State
    from autotuner_sim.plants import Plant


@dataclass(frozen=True, slots=True)
class Relay:
    """Two levels and a dead zone.

    Attributes
    ----------
    low, high : float
        Output levels, as deviations from the output at rest.
    reference : float
        PV around which it switches.
    hysteresis : float
        Half width of the dead zone, PV; 0 for the ideal relay.
    direct : bool
        Whether a higher output raises the PV; False for a plant of negative gain.
    """

    low: float
    high: float
    reference: float = 0.0
    hysteresis: float = 0.0
    direct: bool = True

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(
                f"relay.high must exceed low = {self.low} (got {self.high}). Give the upper level as high."
            )
        if not 0.0 <= self.hysteresis < math.inf:
            raise ValueError(
                f"relay.hysteresis must not be negative (got {self.hysteresis}). Give half the width of the dead zone."
            )

    def level(self, *, is_high: bool) -> float:
        """Return the output in that position."""
        return self.high if is_high else self.low

    def threshold(self, *, is_high: bool) -> tuple[float, int]:
        """Return the PV at which that position ends, and whether the PV has to rise (+1) or fall (-1) through it."""
        direction = 1 if is_high == self.direct else -1
        return self.reference + direction * self.hysteresis, direction


def symmetric_relay(h: float = 1.0, hysteresis: float = 0.0, *, direct: bool = True) -> Relay:
    """Return the relay of the textbook: levels `-h` and `h` around rest; `h` is half the swing."""
    return Relay(-h, h, hysteresis=hysteresis, direct=direct)


@dataclass(frozen=True, slots=True)
class Knot:
    """Where the plant is at the moment its input changes.

    Attributes
    ----------
    t : float
        Moment of the change, s.
    state : tuple of float
        State of the plant's motion.
    u : float
        Input from now on.
    """

    t: float
    state: State
    u: float


@dataclass(frozen=True, slots=True)
class RelayRun:
    """One relay test.

    Attributes
    ----------
    plant : Plant
        What was tested.
    relay : Relay
        With what.
    times_s : array of float, shape (N,)
        When the relay took each position, s; the first is the start, the others are its switches.
    levels : array of float, shape (N,)
        Output from each of those times on.
    knots : tuple of Knot
        The plant at each change of its input, in order; the first is rest.
    end_s : float
        How far the run goes, s.
    """

    plant: Plant
    relay: Relay
    times_s: NDArray[np.float64]
    levels: NDArray[np.float64]
    knots: tuple[Knot, ...]
    end_s: float

    def output(self, t: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the relay's output at the given times; a switch counts from its own time on."""
        behind = np.searchsorted(self.times_s, t, side="right") - 1
        return np.where(behind < 0, 0.0, self.levels[np.maximum(behind, 0)])

    def pv(self, t: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the exact PV at any times, in any order; rest before the start."""
        motion = self.plant.motion()
        starts = [knot.t for knot in self.knots]
        values = np.zeros(len(t))
        for i, when in enumerate(np.asarray(t, dtype=np.float64).tolist()):
            knot = self.knots[max(bisect_right(starts, when) - 1, 0)]
            values[i] = motion.output(motion.move(knot.state, knot.u, max(when - knot.t, 0.0)))
        return values

    def extremes(self, start_s: float, end_s: float) -> tuple[float, float]:
        """Return the lowest and the highest PV from `start_s` to `end_s`, between samples too."""
        motion = self.plant.motion()
        ends = [*(knot.t for knot in self.knots[1:]), math.inf]
        found = [
            extremes(motion, motion.move(knot.state, knot.u, begin - knot.t), knot.u, min(end, end_s) - begin)
            for knot, end in zip(self.knots, ends, strict=True)
            if (begin := max(knot.t, start_s)) < min(end, end_s)
        ]
        return min(low for low, _ in found), max(high for _, high in found)
