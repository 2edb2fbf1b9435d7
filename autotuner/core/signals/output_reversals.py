"""When the output moved, and when it turned back: what the supervisor measures reaction times from.

The output has turned when it has come back from its furthest point by `REVERSED` of the longest way between two turns:
the ramp of a slew limit counts as one move, and neither a register's rounding nor the small moves of a controller
beside the relay count at all. The turn is where it left its furthest point. A way beside which all before it would not
have counted begins anew: what the noise made of a controller's output at rest were no moves.
"""

from __future__ import annotations

import math

REVERSED = 0.3
"""Share of the longest way between two turns that the output has to come back by: more than its noise."""
FULL = 0.9
"""Share of the longest way from which a way counts as full."""


class Moves:
    """Follows the output, sample by sample.

    Attributes
    ----------
    first_s : float or None
        Time of the first move, s.
    turned_s : float
        Time at which the output last turned, s; the first move counts as a turn.
    turns : int
        Turns so far.
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
        back = (self._furthest - output) * math.copysign(1.0, self._furthest - self._from)
        if back <= 0.0:
            self._furthest, self._left_s = output, math.nan
            self._extend(abs(output - self._from))
            return False
        self._left_s = moved_s if math.isnan(self._left_s) else self._left_s
        if back <= REVERSED * self._longest:
            return False
        self._turn(self._left_s)
        self._from, self._furthest, self._left_s = self._furthest, output, math.nan
        self._extend(back)
        return True

    def _extend(self, way: float) -> None:
        """Take note of a way."""
        if self.turns > 1 and self._longest < REVERSED * way:
            self.turns, self.longest_s, self.first_s = 1, 0.0, self.turned_s
        self._longest = max(self._longest, way)

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
