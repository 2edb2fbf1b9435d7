"""Moves and reversals of the output, from which the supervisor measures reaction times.

The output has reversed when it has returned from its extreme by `REVERSED` of the longest way between two reversals:
the ramp of a slew limit counts as one move, and neither a register's rounding nor the small moves of a controller in
parallel with the relay count. The time of a reversal is that of the extreme. When a distance makes all earlier ones
negligible, the count restarts: earlier moves were noise in a controller's output at rest.
"""

from __future__ import annotations

import math

REVERSED = 0.3
"""Return of the output that counts as a reversal, as a share of the longest distance: more than its noise."""
FULL = 0.9
"""Share of the longest distance from which a move counts as full."""


class Moves:
    """Follows the output, sample by sample.

    Attributes
    ----------
    first_s : float or None
        Time of the first move, s.
    turned_s : float
        Time at which the output last turned, s; the first move counts as a turn.
    turns : int
        Reversals so far.
    longest_s : float
        Longest time between two turns, s.
    """

    def __init__(self) -> None:
        self.first_s: float | None = None
        self.turned_s = math.nan
        self.turns = 0
        self.longest_s = 0.0
        self._t = math.nan
        self._from = math.nan
        self._furthest = math.nan
        self._left_s = math.nan
        self._longest = 0.0

    @property
    def is_full(self) -> bool:
        """Whether the output is at the end of a way about as long as the longest one: a relay, not a small hold."""
        return abs(self._furthest - self._from) >= FULL * self._longest > 0.0

    def step(self, t: float, output: float) -> bool:
        """Take the output that was held until `t`; return whether it is seen to have turned."""
        moved_s, self._t = self._t, t
        if self.first_s is None:
            return self._begin(output, moved_s)
        returned = (self._furthest - output) * math.copysign(1.0, self._furthest - self._from)
        if returned <= 0.0:
            self._furthest, self._left_s = output, math.nan
            self._extend(abs(output - self._from))
            return False
        self._left_s = moved_s if math.isnan(self._left_s) else self._left_s
        if returned <= REVERSED * self._longest:
            return False
        self._turn(self._left_s)
        self._from, self._furthest, self._left_s = self._furthest, output, math.nan
        self._extend(returned)
        return True

    def _extend(self, distance: float) -> None:
        """Record a distance."""
        if self.turns > 1 and self._longest < REVERSED * distance:
            self.turns, self.longest_s, self.first_s = 1, 0.0, self.turned_s
        self._longest = max(self._longest, distance)

    def _begin(self, output: float, moved_s: float) -> bool:
        if math.isnan(self._from) or output == self._from:
            self._from = output
            return False
        self.first_s = self.turned_s = moved_s
        self._furthest, self._longest = output, abs(output - self._from)
        self.turns = 1
        return True

    def _turn(self, at_s: float) -> None:
        self.longest_s = max(self.longest_s, at_s - self.turned_s)
        self.turned_s = at_s
        self.turns += 1
