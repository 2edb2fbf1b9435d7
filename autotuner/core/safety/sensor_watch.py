"""Sensor watch: a PV that is frozen, or jumps.

Frozen   a PV that was noisy at rest and now repeats one value, to the last bit; or, for a PV without noise, one that
         has responded to the output before and is constant for much longer than the output ever stayed on one side;
         under a full swing of the relay, for much longer than ever before under the relay: a coarse register, or a
         sensor that reports on change, repeats its value for a limited time. A quantised sensor at rest repeats its
         value too: noise counts only after several different values. In the first half periods of the relay, once
         the PV has left its rest: for much longer than its response took. Before it has switched the relay, its latest
         rate of change must also predict many steps: a PV that settles slows down first.
Jumped   a PV that moves between two samples by a multiple of its largest step so far, and stays there: a wire or a
         sensor that fell off. A single outlier is ignored. The largest step is known once the PV has been
         driven up and down.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from autotuner.core.experiment.phases import Phase
from autotuner.core.signals.output_reversals import Moves
from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.safety.watches import SampleContext
    from autotuner.core.verdict import Verdict

NOISY_VALUES = 4
"""Different values, and turns between them, that a PV must show at rest to count as noisy."""
ROUNDING = 1e-6
"""Range at rest, in the size of the PV, within which changes are rounding and no noise: 16 units in the last place of a
32-bit float. A simulated process without noise, under its controller, may wander among these and then stay."""
LONGER = 10
"""Samples without a change, in the longest such row seen at rest, after which a noisy PV counts as frozen."""
PATIENCE = 3.0
"""Time without a change, in the longest time between two turns of the output, for a PV without noise."""
STEPS = 10.0
"""Range over which such a PV must have moved, in its smallest step: a coarser sensor may well stand still."""
RUN = 3.0
"""Samples without a change under a full swing of the output, in the longest such row seen since it first moved."""
DRIVEN = 3
"""Turns of the output after which steps and times of the PV are known: up, down, up."""
ANSWERED = 3.0
"""Distance from the range of the rest from which the PV has answered, in its smallest step."""
RECENT = 4
"""Latest changes of the PV that its rate is taken from."""
EXPECTED = 30.0
"""Missing change that the rate predicted, in the smallest step: for a PV that settles exponentially within its
last step, 2.2 are predicted in each time constant, which leaves the relay's own decision 14 of these."""
JUMP = 5.0
"""Step that counts as a jump, in the largest step before."""
CONFIRMED = 3
"""Samples for which the PV must stay after a jump."""


class FrozenWatch:
    """The PV must not stand still where it cannot.

    Parameters
    ----------
    fewest : int
        Fewest samples without any change before a noisy PV counts as frozen.
    """

    def __init__(self, fewest: int) -> None:
        self._fewest = fewest
        self._moves = Moves()
        self._rest = RestPattern()
        self._pv = math.nan
        self._same = self._longest_driven = 0
        self._since_s = math.nan
        self._range = (math.inf, -math.inf)
        self._resolution = math.inf
        self._driven_samples = self._waited = 0
        self._changes: deque[tuple[float, float]] = deque(maxlen=RECENT)

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when the sensor must be dead."""
        sample = context.sample
        self._moves.step(sample.t, sample.output)
        if self._moves.first_s is None:
            self._rest.step(sample.pv)
        self._follow(sample.t, sample.pv)
        self._driven_samples += self._moves.first_s is not None
        if not self._waited and self._rest.distance(sample.pv) >= ANSWERED * self._resolution:
            self._waited = self._driven_samples
        longest, still_s = max(self._fewest, LONGER * self._rest.longest), sample.t - self._since_s
        if self._rest.noisy and self._same >= longest:
            return _frozen(sample, f"{self._same} samples, though it is noisy (limit {longest})")
        moving = max(self._fewest, RUN * self._longest_driven)
        moved = self._driven and self._moves.is_full and not self._rest.noisy
        if moved and self._same > moving:
            return _frozen(sample, f"{self._same} samples, though the output drives it (limit {moving:g})")
        if context.phase == Phase.RELAY and self._moves.turns < DRIVEN and self._stopped(sample.t):
            return _frozen(sample, f"{self._same} samples, though it had answered the output after {self._waited}")
        oscillates = context.phase == Phase.RELAY and self._moves.turns >= DRIVEN  # for a coarse sensor too
        if (self._driven or oscillates) and still_s > PATIENCE * self._moves.longest_s:
            return _frozen(sample, f"{still_s:.4g} s of driving it (limit {PATIENCE * self._moves.longest_s:.4g} s)")
        return None

    def _follow(self, t: float, pv: float) -> None:
        if pv == self._pv:
            self._same += 1
            return
        if not math.isnan(self._pv):
            self._resolution = min(self._resolution, abs(pv - self._pv))
        first_s = self._moves.first_s
        if first_s is not None:
            if self._since_s > first_s:
                self._longest_driven = max(self._longest_driven, self._same)
            self._range = (min(self._range[0], pv), max(self._range[1], pv))
        self._pv, self._same, self._since_s = pv, 1, t
        self._changes.append((t, pv))

    def _stopped(self, t: float) -> bool:
        """Return whether a PV that has answered is suddenly frozen."""
        longest = max(self._fewest, RUN * max(self._waited, self._longest_driven))
        stopped = self._waited > 0 and self._moves.is_full and self._same > longest
        return stopped and (self._moves.turns > 1 or self._rate * (t - self._since_s) > EXPECTED * self._resolution)

    @property
    def _rate(self) -> float:
        """Latest rate of change of the PV, PV units/s."""
        (first_s, first), (last_s, last) = self._changes[0], self._changes[-1]
        return abs(last - first) / (last_s - first_s) if last_s > first_s else 0.0

    @property
    def _driven(self) -> bool:
        """Whether the PV has followed the output far enough to be expected to continue."""
        low, high = self._range
        return self._moves.turns >= DRIVEN and high - low >= STEPS * self._resolution


def _frozen(sample: Sample, how_long: str) -> Verdict:
    return aborted(
        "pv_frozen",
        f"the PV repeats {sample.pv:.5g} without any change for {how_long}, at {sample.t:.3f} s",
        "Check the sensor and its wiring, or raise safety.frozen_samples.",
    )


class RestPattern:
    """Changes of a PV while the output rests.

    Attributes
    ----------
    longest : int
        Longest row of equal values that has ended.
    """

    def __init__(self) -> None:
        self.longest = 0
        self._same = 0
        self._values: set[float] = set()
        self._turns = 0
        self._pv = math.nan
        self._step = 0.0
        self._low, self._high = math.inf, -math.inf

    @property
    def noisy(self) -> bool:
        """Whether the PV had several values: dither between two neighbours is not enough."""
        wide = self._high - self._low > ROUNDING * max(abs(self._high), abs(self._low))
        return wide and len(self._values) >= NOISY_VALUES and self._turns >= NOISY_VALUES

    def distance(self, pv: float) -> float:
        """Return how far a PV is from the range that was seen at rest, PV units."""
        return max(self._low - pv, pv - self._high, 0.0)

    def step(self, pv: float) -> None:
        """Take a sample at rest."""
        self._same += 1
        self._low, self._high = min(self._low, pv), max(self._high, pv)
        if pv == self._pv:
            return
        step = 0.0 if math.isnan(self._pv) else pv - self._pv
        self._turns += step * self._step < 0.0
        self.longest = max(self.longest, self._same)
        self._pv, self._step, self._same = pv, step, 0
        if len(self._values) < NOISY_VALUES:
            self._values.add(pv)


class JumpWatch:
    """The PV must not leap."""

    def __init__(self) -> None:
        self._moves = Moves()
        self._first_s: float | None = None
        self._before_s = 0.0
        self._count = 0
        self._pv = math.nan
        self._largest = 0.0
        self._away = 0

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when the PV has jumped and stays there."""
        sample = context.sample
        self._moves.step(sample.t, sample.output)
        step, intervals = abs(sample.pv - self._pv), self._intervals(sample.t)
        if self._moves.turns < DRIVEN or step <= JUMP * self._largest * intervals:
            self._largest = max(self._largest, step / intervals) if self._count > 1 else 0.0
            self._pv, self._away = sample.pv, 0
            return None
        self._away += 1
        if self._away < CONFIRMED:
            return None
        return aborted(
            "pv_jumped",
            f"the PV jumped from {self._pv:.5g} to {sample.pv:.5g} and stays there at {sample.t:.3f} s; "
            f"its largest step before was {self._largest:.3g} (limit {JUMP:g} times that)",
            "Check the sensor and its wiring, then start again.",
        )

    def _intervals(self, t: float) -> float:
        """Return the time since the sample before, in mean intervals, 1 at least: after a gap the PV may be further."""
        if self._first_s is None:
            self._first_s = self._before_s = t
        elapsed_s, self._before_s = t - self._before_s, t
        self._count += 1
        return max(elapsed_s * (self._count - 1) / (t - self._first_s), 1.0) if t > self._first_s else 1.0
