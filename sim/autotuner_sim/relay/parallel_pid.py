"""A relay in parallel with a running PID controller: exact switches, the controller integrated in fine steps.

    u = relay(y) - Kp (yf + I/Ti + Td yf'),   I' = yf,   yf + Tf yf' + Tf^2/2 yf'' = y,   y = G u

`y` PV and `u` output, as deviations from rest, where the set point is too; the relay switches about its own reference.
The controller is continuous. Over a step, a whole fraction of the dead time, the plant's input is that of the relay,
switched at its own moments, plus the mean of the controller's output at both ends of the step one dead time ago; and
the controller sees `y` as straight. Both leave an error of the second order of the step. The scheme: B. Kumar, M.Tech.
thesis, Indian Institute of Technology Guwahati, section 1.3.2.

`Kp` output/PV; `Ti`, `Td`, `Tf` s.

Invariants: no switch is rounded to a step; the moments at which the plant's input changes are samples too, so
that no corner of the PV is missed.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner_sim.plants.crossing import first_crossing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from autotuner_sim.plants.linear import Plant
    from autotuner_sim.relay.run import Relay


@dataclass(frozen=True, slots=True)
class Pid:
    """A continuous controller: `Kp` output/PV; `Ti` (infinite for no integral), `Td`, `Tf` (0 for no filter) s."""

    Kp: float
    Ti: float = math.inf
    Td: float = 0.0
    Tf: float = 0.0


@dataclass(frozen=True, slots=True)
class ParallelRun:
    """One relay test in parallel with a controller.

    Attributes
    ----------
    t, pv : array of float, shape (N,)
        Samples at each step and at each change of the plant's input in between, s and PV.
    relay : array of float, shape (N,)
        The relay's part of the output from each of them on.
    switches_s : array of float, shape (M,)
        The exact moments at which the relay switched, s.
    """

    t: NDArray[np.float64]
    pv: NDArray[np.float64]
    relay: NDArray[np.float64]
    switches_s: NDArray[np.float64]

    @property
    def period_s(self) -> float:
        """Length of the last full period, s; three switches at least."""
        return float(self.switches_s[-1] - self.switches_s[-3])

    @property
    def peak(self) -> float:
        """Amplitude of the PV over the last full period, zero to peak."""
        return float(np.ptp(self._last_period()[1])) / 2.0

    @property
    def fundamental(self) -> float:
        """Amplitude of the fundamental of the PV over the last full period."""
        t, pv = self._last_period()
        turned = (pv - pv.mean()) * np.exp(-2j * math.pi / self.period_s * t)
        return float(abs(np.trapezoid(turned, t))) * 2.0 / self.period_s

    def _last_period(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rows = (self.t >= self.switches_s[-3]) & (self.t <= self.switches_s[-1])
        return self.t[rows], self.pv[rows]


def run_parallel_relay(plant: Plant, relay: Relay, pid: Pid, end_s: float, step_s: float) -> ParallelRun:
    """Run a relay test in parallel with a controller, from rest.

    Parameters
    ----------
    plant : Plant
        The plant, at rest until `t = 0`; its dead time is positive.
    relay : Relay
        The relay, high at first where the PV at rest allows either.
    pid : Pid
        The controller; its sign is that of the plant's gain.
    end_s : float
        When the run ends, s.
    step_s : float
        Longest step, s.

    Raises
    ------
    ValueError
        A plant without dead time.
    """
    if not plant.D > 0.0:
        raise ValueError(f"plant.D must be positive (got {plant.D}). Give the plant a dead time.")
    simulation = _Simulation(plant, relay, pid, plant.D / math.ceil(plant.D / step_s))
    while simulation.t[-1] < end_s:
        simulation.advance()
    return ParallelRun(
        np.array(simulation.t), np.array(simulation.pv), np.array(simulation.levels), np.array(simulation.switches_s)
    )


class _Simulation:
    """The run as far as it is known."""

    def __init__(self, plant: Plant, relay: Relay, pid: Pid, step_s: float) -> None:
        self.motion, self.relay = plant.motion(), relay
        self.dead_time, self.step_s, self.steps = plant.D, step_s, 0
        self.controller = _Controller(pid, step_s)
        self.state = self.motion.rest
        threshold, direction = relay.threshold(is_high=True)
        self.is_high = direction * threshold >= 0.0
        self.arriving = 0.0
        self.arrivals = deque([(self.dead_time, relay.level(is_high=self.is_high))])
        self.controlled = deque([0.0] * (round(plant.D / step_s) + 1))
        self.t, self.pv, self.levels = [0.0], [0.0], [relay.level(is_high=self.is_high)]
        self.switches_s: list[float] = []

    def advance(self) -> None:
        """Go on by one step."""
        self.steps += 1
        end_s = self.steps * self.step_s
        controlled = (self.controlled[0] + self.controlled[1]) / 2.0
        while self.arrivals and self.arrivals[0][0] < end_s:
            arrives_s, level = self.arrivals.popleft()
            self._move(arrives_s, self.arriving + controlled)
            self.arriving = level
        self._move(end_s, self.arriving + controlled)
        self.controlled.popleft()
        self.controlled.append(self.controller.update(self.pv[-1]))

    def _move(self, end_s: float, u: float) -> None:
        """Advance the plant under a constant input, with the relay's switches on the way."""
        while (span := end_s - self.t[-1]) > 0.0:
            threshold, direction = self.relay.threshold(is_high=self.is_high)
            just_switched = bool(self.switches_s) and self.t[-1] == self.switches_s[-1]
            short_of = -2.0 * self.relay.hysteresis if just_switched else None
            wait = first_crossing(self.motion, self.state, u, threshold, direction, span, at_start=short_of)
            moved = span if wait is None else wait
            self.state = self.motion.move(self.state, u, moved)
            self.t.append(end_s if wait is None else self._switch(self.t[-1] + wait))
            self.pv.append(self.motion.output(self.state))
            self.levels.append(self.relay.level(is_high=self.is_high))

    def _switch(self, t: float) -> float:
        self.is_high = not self.is_high
        self.switches_s.append(t)
        self.arrivals.append((t + self.dead_time, self.relay.level(is_high=self.is_high)))
        return t


class _Controller:
    """The controller, by the matrix exponential of its states for a PV that moves in a straight line."""

    def __init__(self, pid: Pid, step_s: float) -> None:
        self.pid, self.step_s = pid, step_s
        self.before = 0.0
        self.states = np.zeros(3)
        if pid.Tf > 0.0:
            motion = np.zeros((5, 5))  # of yf, yf', I, y, y'
            motion[0, 1] = motion[2, 0] = motion[3, 4] = 1.0
            motion[1, :4] = np.array([-1.0, -pid.Tf, 0.0, 1.0]) * 2.0 / pid.Tf**2
            self.transition = scipy.linalg.expm(motion * step_s)[:3]

    def update(self, pv: float) -> float:
        """Take the PV at the end of a step; return the controller's output there."""
        slope = (pv - self.before) / self.step_s
        if self.pid.Tf > 0.0:
            self.states = self.transition @ np.array([*self.states, self.before, slope])
        else:
            self.states = np.array([pv, slope, self.states[2] + (pv + self.before) / 2.0 * self.step_s])
        self.before = pv
        filtered, filtered_slope, integral = self.states
        return float(-self.pid.Kp * (filtered + integral / self.pid.Ti + self.pid.Td * filtered_slope))
