"""When the output moved, and when it turned back: what the supervisor measures reaction times from.

A row of moves in one direction (the ramp of a slew limit, a staircase upward) counts as one; it begins with its first.
A change under `MINOR` of the largest one is a register's rounding, not a move.
"""

from __future__ import annotations

import math

MINOR = 0.05


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
        self._level = math.nan
        self._largest = 0.0
        self._direction = 0.0

    def step(self, t: float, output: float) -> bool:
        """Take the output that was held until `t`; return whether it turned at the sample before."""
        moved_s, self._t = self._t, t
        if math.isnan(self._level):
            self._level = output
        change = output - self._level
        if abs(change) <= MINOR * self._largest:
            return False
        self._level, self._largest = output, max(self._largest, abs(change))
        return self._take_move(math.copysign(1.0, change), moved_s)

    def _take_move(self, direction: float, moved_s: float) -> bool:
        if direction == self._direction:
            return False
        if self.first_s is None:
            self.first_s = moved_s
        else:
            self.longest_s = max(self.longest_s, moved_s - self.turned_s)
        self._direction, self.turned_s = direction, moved_s
        self.turns += 1
        return True
