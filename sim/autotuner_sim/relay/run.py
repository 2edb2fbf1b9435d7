"""Relay tests of any plant, event by event: the relay, the simulation, and the exact PV of its result.

    output = high   from the moment at which pv < reference - hysteresis
    output = low    from the moment at which pv > reference + hysteresis

(the other way round for a reverse plant). The output reaches the plant one dead time after the switch. Between two such
arrivals the input is constant and the PV is known in closed form, so the next switch is the root of one monotone piece
of it; arrivals and switches are taken in order of time, with any number of switches on their way. A load enters at the
plant's input without the dead time. Times s, levels in output units and PV as deviations from rest, where the plant is
before `t = 0`.

Invariants: nothing is stepped and nothing is rounded to a grid; a relay without finite period is refused; a run
keeps the plant's state at each change of its input, so every PV read from it is exact.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner_sim.plants.crossing import extremes, first_crossing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from autotuner_sim.plants.linear import Plant
    from autotuner_sim.plants.motion import State


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
    """State of the plant when its input changes.

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
        The process.
    relay : Relay
        The relay.
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
        index = np.searchsorted(self.times_s, t, side="right") - 1
        return np.where(index < 0, 0.0, self.levels[np.maximum(index, 0)])

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


def run_relay(
    plant: Plant,
    relay: Relay,
    end_s: float,
    *,
    max_switches: int = 100_000,
    start_high: bool = True,
    load_s: float = 0.0,
    load: float = 0.0,
) -> RelayRun:
    """Run a relay test from rest.

    Parameters
    ----------
    plant : Plant
        The plant, at rest until `t = 0`.
    relay : Relay
        The relay, which takes its first position at `t = 0`.
    end_s : float
        When the run ends, s.
    max_switches : int
        The run ends earlier, with this many switches.
    start_high : bool
        The first position, where the PV at rest allows either.
    load_s, load : float
        From `load_s` on, `load` is added to the plant's input, output units.

    Returns
    -------
    RelayRun
        Its switches may be few or none: a plant need not oscillate.

    Raises
    ------
    ValueError
        The relay would switch infinitely often in no time: an ideal relay on a plant without dead time.
    """
    simulation = _Simulation(plant, relay, start_high=start_high)
    if load:
        simulation.expect(load_s, "load", load)
    while len(simulation.times) <= max_switches and simulation.advance(end_s):
        pass
    last = end_s if len(simulation.times) <= max_switches else simulation.times[-1]
    return RelayRun(
        plant, relay, np.array(simulation.times), np.array(simulation.levels), tuple(simulation.knots), last
    )


class _Simulation:
    """The run as far as it is known."""

    def __init__(self, plant: Plant, relay: Relay, *, start_high: bool) -> None:
        self.motion = plant.motion()
        self.relay = relay
        self.dead_time = plant.D
        self.arrivals: list[tuple[float, int, str, float]] = []
        self.announced = 0
        self.inputs = {"relay": 0.0, "load": 0.0}
        self.knots = [Knot(0.0, self.motion.rest, 0.0)]
        self.times: list[float] = []
        self.levels: list[float] = []
        threshold, direction = relay.threshold(is_high=start_high)
        self.is_high = start_high != (direction * (self.motion.output(self.motion.rest) - threshold) > 0.0)
        self._take_position(0.0)

    def expect(self, t: float, source: str, value: float) -> None:
        """Announce a change of the plant's input; of two at the same time the later announced comes last."""
        heapq.heappush(self.arrivals, (t, self.announced, source, value))
        self.announced += 1

    def advance(self, end_s: float) -> bool:
        """Go on to the next arrival or switch; return False when the end comes first."""
        knot = self.knots[-1]
        horizon = min(self.arrivals[0][0] if self.arrivals else math.inf, end_s)
        searched_from = max(knot.t, self.times[-1])
        state = self.motion.move(knot.state, knot.u, searched_from - knot.t)
        threshold, direction = self.relay.threshold(is_high=self.is_high)
        wait = first_crossing(
            self.motion,
            state,
            knot.u,
            threshold,
            direction,
            horizon - searched_from,
            at_start=self._distance_after_switch(searched_from),
        )
        if wait is not None:
            self.is_high = not self.is_high
            self._take_position(searched_from + wait)
            return True
        if horizon >= end_s:
            return False
        self._arrive()
        return True

    def _distance_after_switch(self, t: float) -> float | None:
        """Return how far the PV is beyond the next threshold at a switch: the dead zone short of it, unrounded."""
        return -2.0 * self.relay.hysteresis if len(self.times) > 1 and t == self.times[-1] else None

    def _take_position(self, t: float) -> None:
        if self.times[-2:] == [t, t]:
            raise ValueError(
                f"the relay switches without end at t = {t:.6g} s: an ideal relay on a plant without dead time has no "
                "period. Give the relay a hysteresis, or the plant a dead time."
            )
        self.times.append(t)
        self.levels.append(self.relay.level(is_high=self.is_high))
        self.expect(t + self.dead_time, "relay", self.levels[-1])

    def _arrive(self) -> None:
        t, _, source, value = heapq.heappop(self.arrivals)
        self.inputs[source] = value
        knot = self.knots[-1]
        state = self.motion.move(knot.state, knot.u, t - knot.t)
        self.knots.append(Knot(t, state, self.inputs["relay"] + self.inputs["load"]))
