"""Check after the relay: a record of effects that a relay record cannot show.

    half relay    the relay at half its amplitude, for `HALF_SWITCHES` switches
    staircase     small holds up and down about the equilibrium, `STAIRS` in parts of h
    tail          a few levels at another bias, never fitted
    return        an integrating process only: the level that returns the PV to its initial value

A relay moves the output between two levels only: a dead band and stiction then resemble a slower, weaker process. The
smaller moves distinguish them, and the tail is the held-out part of the record on which a model is judged.

`h` is the relay amplitude, `Pu` the period of the oscillation. Every level lies within the levels of the relay, so
the check pushes no harder than the relay did. It ends early, with a warning, when the PV leaves `WIDEST` oscillation
amplitudes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.experiment.phases import PhaseEvent
from autotuner.core.experiment.step import Step
from autotuner.core.notes import Note

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.experiment.relay import Relay
    from autotuner.core.recording import Sample
    from autotuner.core.signals.detector import Cycle

HALF_SWITCHES = 4
"""Switches of the relay at half amplitude: two periods, of which the second is at rest."""
STAIRS = (0.25, 0.5, 0.25, 0.0, -0.25, -0.5, -0.25, 0.0, 0.5, -0.25)
"""Levels of the staircase, in relay amplitudes off the equilibrium: small moves up and down, then two larger ones."""
TAIL = (0.6, 0.2, 0.6, -0.6, 0.1)
"""Levels of the tail, in relay amplitudes off the equilibrium."""
HOLD_PERIODS = 0.4
"""Length of a hold, in Pu: no shorter than the dead time of most processes, which is a quarter to a half of Pu."""
WIDEST = 4.0
"""Distance of the PV from the reference, in oscillation amplitudes, at which the check is cut short."""
LONGEST_RETURN = 4.0
"""Longest time in which an integrating process is brought back, in Pu."""
PATIENCE = 4.0
"""Longest half period under half the amplitude, in periods under the full one."""


@dataclass(frozen=True, slots=True)
class Oscillated:
    """Results of the relay phase that determine the check: the relay, and its last full period."""

    relay: Relay
    cycle: Cycle

    def level(self, part: float) -> float:
        """Return the output `part` amplitudes off the equilibrium, within the levels of the relay.

        The mean of the output over a period is the output in equilibrium with the reference.
        """
        relay = self.relay
        equilibrium = relay.low + self.cycle.duty * (relay.high - relay.low)
        return min(max(equilibrium + part * relay.amplitude, relay.low), relay.high)

    def too_far(self, pv: float) -> bool:
        """Return whether the PV has left the range in which the check may move it."""
        return abs(pv - self.relay.reference) > WIDEST * max(self.cycle.peak, self.relay.hysteresis)


class HalfRelay:
    """The relay at half its amplitude about the equilibrium."""

    def __init__(self, found: Oscillated, started_s: float, *, is_high: bool) -> None:
        self.found = found
        self._relay = replace(found.relay, low=found.level(-0.5), high=found.level(0.5))
        self._is_high = is_high
        self._switches = 0
        self._half_started_s = started_s

    @property
    def output(self) -> float:
        """The level in force, output units."""
        return self._relay.level(is_high=self._is_high)

    def step(self, sample: Sample) -> Step:
        """Switch; after enough switches, or when the oscillation ends, continue with the staircase."""
        if self.found.too_far(sample.pv):
            return _cut_short(self.output)
        is_high = self._relay.switched(is_high=self._is_high, pv=sample.pv)
        if is_high != self._is_high:
            self._is_high, self._half_started_s = is_high, sample.t
            self._switches += 1
        waited_s = sample.t - self._half_started_s
        if self._switches < HALF_SWITCHES and waited_s < PATIENCE * self.found.cycle.period_s:
            return Step(self.output)
        holds = Holds(self.found, "staircase", STAIRS, sample.t)
        return Step(holds.output, following=holds, segment=holds.name)


class Holds:
    """A row of levels, each held for a part of the period."""

    def __init__(self, found: Oscillated, name: str, parts: tuple[float, ...], started_s: float) -> None:
        self.name = name
        self.found = found
        self._levels = [found.level(part) for part in parts]
        self._started_s = started_s
        self._row = 0

    @property
    def output(self) -> float:
        """The level in force, output units."""
        return self._levels[self._row]

    def step(self, sample: Sample) -> Step:
        """Move to the level that is due; after the last one continue with the tail, or end the check."""
        if self.found.too_far(sample.pv):
            return _cut_short(self.output)
        self._row = int((sample.t - self._started_s) / (HOLD_PERIODS * self.found.cycle.period_s))
        if self._row < len(self._levels):
            return Step(self.output)
        self._row = len(self._levels) - 1
        if self.name == "tail":
            return Step(self.output, PhaseEvent.CHECKED)
        tail = Holds(self.found, "tail", TAIL, sample.t)
        return Step(tail.output, following=tail, segment=tail.name)


class Return:
    """Return the PV of an integrating process: the output removes the displacement, within the levels of the relay.

    The far level is held until what is left to remove is less than a sample of it; a last sample removes that.

    Parameters
    ----------
    found : Oscillated
        What the relay found.
    left : callable
        Returns the impulse of the output that displaces the PV from its start, output units s, see `Displacement`.
    rest : float
        Output at rest, output units.
    began : Sample
        First sample of this stage; the PV may be far from its reference then, which does not end the stage.
    sample_time_s : float
        Time between samples, s.
    """

    def __init__(
        self, found: Oscillated, left: Callable[[], float], rest: float, began: Sample, sample_time_s: float
    ) -> None:
        self.found, self._left, self._rest, self._began_pv = found, left, rest, began.pv
        self._until_s = began.t + LONGEST_RETURN * found.cycle.period_s
        self._sample_time_s = sample_time_s
        self._is_last = False
        self.output = self._level()

    def step(self, sample: Sample) -> Step:
        """Hold the level until the PV will return by itself; it responds only after the dead time."""
        if self._is_last or sample.t >= self._until_s or self._runs_away(sample.pv):
            return Step(self.output, PhaseEvent.CHECKED)
        self.output = self._level()
        return Step(self.output)

    def _level(self) -> float:
        relay, wanted = self.found.relay, self._rest - self._left() / self._sample_time_s
        self._is_last = relay.low <= wanted <= relay.high
        return min(max(wanted, relay.low), relay.high)

    def _runs_away(self, pv: float) -> bool:
        """Return whether the PV is too far on the other side, or has gone on as far again on the one it was on."""
        reference = self.found.relay.reference
        distance = abs(self._began_pv - reference)
        farther = abs(pv - reference) > distance and self.found.too_far(pv - math.copysign(distance, pv - reference))
        crossed = (pv - reference) * (self._began_pv - reference) < 0.0
        return farther or (crossed and self.found.too_far(pv))


def _cut_short(output: float) -> Step:
    warning = Note(f"the check was cut short: the PV left {WIDEST:g} times the amplitude of the oscillation")
    return Step(output, PhaseEvent.CHECKED, warning=warning)
