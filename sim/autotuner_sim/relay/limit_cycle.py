"""The steady limit cycle of a plant under a relay, solved for instead of waited for.

With the plant's input high for `t_h` and then low for `t_l`, and `x0` its state when the input turns high,

    x0 = move(move(x0, high, t_h), low, t_l)            periodic
    pv(t_h - D)       = reference + hysteresis          the switch down, one dead time before it reaches the plant
    pv(t_h + t_l - D) = reference - hysteresis          the switch up

(for a direct plant; phases are taken modulo the period, so the dead time may exceed it). These `n + 2` equations in
`(x0, t_h, t_l)` hold for stable, integrating and unstable plants alike; Newton's method starts from a short exact run,
which also determines which of several cycles is the one reached from rest. Source: Astrom, Oscillations in systems with
relay feedback (1995); Majhi and Atherton, Autotuning and controller design for processes with small time delays (1999).

The amplitudes are exact too. The peak is read at the turning points. The fundamental of the PV is `|G(jw)|` times that
of the input, whose levels `high` and `low` alternate:

    A1 = |G(jw)| (high - low) (2/pi) sin(pi t_h / Pu),   w = 2 pi / Pu

Times in s, amplitudes zero to peak in PV units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner_sim.plants.crossing import extremes
from autotuner_sim.relay.run import run_relay

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from autotuner_sim.plants.linear import Plant
    from autotuner_sim.plants.motion import State
    from autotuner_sim.relay.run import Relay, RelayRun

_ATTEMPTS = (12, 40, 200, 1000)
"""Switches of the run that Newton starts from: the shortest that leads to a cycle it confirms is enough."""
_CONFIRMED_WITHIN = 0.02
"""Relative difference of the run's last half periods from the solved ones."""
_CLOSED_WITHIN = 1e-9
"""Largest accepted residual of the equations, relative to the amplitude."""


@dataclass(frozen=True, slots=True)
class LimitCycle:
    """A steady oscillation under a relay.

    Attributes
    ----------
    plant : Plant
        The process.
    relay : Relay
        The relay.
    start : tuple of float
        State of the plant's motion when its input turns high.
    high_s, low_s : float
        Time at each level in one period, s.
    """

    plant: Plant
    relay: Relay
    start: State
    high_s: float
    low_s: float

    @property
    def period_s(self) -> float:
        """The ultimate period `Pu`, s."""
        return self.high_s + self.low_s

    @property
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest PV."""
        motion = self.plant.motion()
        middle = motion.move(self.start, self.relay.high, self.high_s)
        rise = extremes(motion, self.start, self.relay.high, self.high_s)
        fall = extremes(motion, middle, self.relay.low, self.low_s)
        return min(rise[0], fall[0]), max(rise[1], fall[1])

    @property
    def peak(self) -> float:
        """Amplitude `A`, zero to peak: half the distance of the extremes, PV."""
        lowest, highest = self.extremes
        return (highest - lowest) / 2.0

    @property
    def fundamental(self) -> float:
        """Amplitude `A1` of the fundamental harmonic, PV."""
        gain = abs(self.plant.transfer(2j * math.pi / self.period_s))
        swing = self.relay.high - self.relay.low
        return gain * swing * 2.0 / math.pi * math.sin(math.pi * self.high_s / self.period_s)

    def pv(self, t: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the PV at times after the plant's input turns high, s; periodic."""
        motion = self.plant.motion()
        middle = motion.move(self.start, self.relay.high, self.high_s)
        values = np.zeros(len(t))
        for i, phase in enumerate((np.asarray(t, dtype=np.float64) % self.period_s).tolist()):
            if phase < self.high_s:
                values[i] = motion.output(motion.move(self.start, self.relay.high, phase))
            else:
                values[i] = motion.output(motion.move(middle, self.relay.low, phase - self.high_s))
        return values

    def output(self, t: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the relay's output at the same times; it leads the plant's input by the dead time."""
        phase = (np.asarray(t, dtype=np.float64) + self.plant.D) % self.period_s
        return np.where(phase < self.high_s, self.relay.high, self.relay.low)

    def residual(self) -> float:
        """Return by how much the equations of this file are missed, relative to the amplitude."""
        worst = np.max(np.abs(_equations(self)))
        return float(worst) / max(self.peak, 1e-300)


def find_limit_cycle(plant: Plant, relay: Relay) -> LimitCycle:
    """Return the steady limit cycle that a relay test from rest ends in.

    Parameters
    ----------
    plant : Plant
        The plant.
    relay : Relay
        The relay.

    Raises
    ------
    ValueError
        The plant does not oscillate from rest, or has not settled on a cycle of two switches a period within the
        longest run: it may settle later, on another cycle, or never.
    """
    for switches in _ATTEMPTS:
        first = _from_run(plant, relay, switches)
        if first is None:
            raise ValueError(
                f"{plant} does not oscillate from rest under {relay}. Give levels on both sides of rest, a hysteresis "
                "that the PV can cross, and for an unstable plant a dead time that it can bear."
            )
        cycle = _solve(first)
        if cycle is not None and _same_times(first, cycle):
            return cycle
    raise ValueError(
        f"{plant} has not settled on a cycle with two switches a period within {_ATTEMPTS[-1]} switches under {relay}. "
        "Read the run itself, or give more damping or a larger hysteresis."
    )


def _from_run(plant: Plant, relay: Relay, switches: int) -> LimitCycle | None:
    """Return the last full period of a short run as if it were a cycle, or None when the run hardly switches."""
    end_s = 1e6 * (plant.D + plant.motion().time_scale_s)
    run = run_relay(plant, relay, end_s, max_switches=switches)
    rises = np.flatnonzero(run.levels[1:-2] == relay.high) + 1
    if not rises.size:
        return None
    up, down, up_again = run.times_s[rises[-1] : rises[-1] + 3].tolist()
    return LimitCycle(plant, relay, _state_at(run, up + plant.D), down - up, up_again - down)


def _state_at(run: RelayRun, t: float) -> State:
    before = [knot for knot in run.knots if knot.t <= t][-1]
    return run.plant.motion().move(before.state, before.u, t - before.t)


def _equations(cycle: LimitCycle) -> NDArray[np.float64]:
    """Return the residuals of the equations at the head of this file, PV units or those of the state."""
    motion, relay, D = cycle.plant.motion(), cycle.relay, cycle.plant.D
    after = motion.move(motion.move(cycle.start, relay.high, cycle.high_s), relay.low, cycle.low_s)
    thresholds = [relay.threshold(is_high=is_high)[0] for is_high in (True, False)]
    at_switches = cycle.pv([cycle.high_s - D, cycle.period_s - D])
    return np.concatenate((np.subtract(after, cycle.start), at_switches - thresholds))


def _solve(first: LimitCycle) -> LimitCycle | None:
    def cycle_of(unknowns: NDArray[np.float64]) -> LimitCycle:
        *start, high_s, low_s = unknowns.tolist()
        return LimitCycle(first.plant, first.relay, tuple(start), abs(high_s), abs(low_s))

    def miss(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        return _equations(cycle_of(unknowns))

    start = np.array([*first.start, first.high_s, first.low_s])
    cycle = cycle_of(scipy.optimize.root(miss, start, tol=1e-15).x)
    return cycle if cycle.residual() < _CLOSED_WITHIN else None


def _same_times(one: LimitCycle, other: LimitCycle) -> bool:
    return math.isclose(one.high_s, other.high_s, rel_tol=_CONFIRMED_WITHIN) and math.isclose(
        one.low_s, other.low_s, rel_tol=_CONFIRMED_WITHIN
    )
