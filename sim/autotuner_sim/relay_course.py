"""A relay test, event by event: exact switching times, however many of them are on their way through the dead time.

The output reaches the plant `D` seconds after the switch. Between two such arrivals the input is constant and the PV
is known in closed form, so the next switch is the root of one monotone piece of it; arrivals and switches are taken in
their order in time. A load enters at the plant's input without the dead time.

Rules of this file: nothing is stepped and nothing is rounded to a grid; a relay without finite period is refused.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner_sim.crossing import first_crossing
from autotuner_sim.relay import Knot, Relay, RelayRun

if TYPE_CHECKING:
    from autotuner_sim.plants import Plant


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
    course = _Course(plant, relay, start_high=start_high)
    if load:
        course.expect(load_s, "load", load)
    while len(course.times) <= max_switches and course.advance(end_s):
        pass
    last = end_s if len(course.times) <= max_switches else course.times[-1]
    return RelayRun(plant, relay, np.array(course.times), np.array(course.levels), tuple(course.knots), last)


class _Course:
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
