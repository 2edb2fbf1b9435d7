"""How much one client may ask: a bucket of requests that fills with time.

    level = min(burst, level + rate dt) - 1

Rule of this file: what is remembered is bounded, however many addresses ask.
"""

from __future__ import annotations

from collections import OrderedDict

REMEMBERED = 4096
"""Addresses remembered; the one that was quiet longest goes first, with a full bucket."""


class Buckets:
    """The buckets of all clients.

    Parameters
    ----------
    rate_per_s : float
        Requests that come back each second.
    burst : float
        Most requests at once.
    """

    def __init__(self, rate_per_s: float, burst: float) -> None:
        self._rate, self._burst = rate_per_s, burst
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str, now_s: float) -> float:
        """Take one request out of a client's bucket; return 0, or how long to wait when there is none, s."""
        level, then_s = self._levels.pop(client, (self._burst, now_s))
        level = min(self._burst, level + self._rate * (now_s - then_s))
        left = level - 1.0 if level >= 1.0 else level
        self._levels[client] = (left, now_s)
        if len(self._levels) > REMEMBERED:
            self._levels.popitem(last=False)
        return 0.0 if level >= 1.0 else (1.0 - level) / self._rate
