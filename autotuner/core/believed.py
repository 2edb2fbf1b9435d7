"""The PV by which the relay decides: the median of the latest readings, where a single one may be noise.

    w = 1        where the dead zone is wide enough (`SURE` sigma), and shortly after a switch
        3, 5     once 30, 100 readings have come since (`WIDTHS`)

With a dead zone of 3 sigma, one reading in 700 lies beyond it on one side. At rest, before the process has answered,
the relay waits there for a dead time, which at a high sampling rate is thousands of readings: noise alone would switch
it. Three readings of five lie beyond in one case of forty million. The price is a switch that comes (w - 1)/2 readings
late, at most 3 % of a half period; and a single wild reading switches nothing.
"""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.relay import Relay

SURE = 4.5
"""Half width of a dead zone in standard deviations of the noise, from which a single reading is believed."""
WIDTHS = ((100, 5), (30, 3))
"""Readings since the last switch, and of how many the median is then taken."""


class Believed:
    """Takes every reading of a relay.

    Parameters
    ----------
    hysteresis, noise_sigma : float
        Half width of the dead zone and noise of the PV, PV units.
    from_rest : bool
        Whether the PV is at rest within the dead zone at first. The half period that begins so is longer than all that
        follow, and does not count for them: the widest median at once.
    """

    def __init__(self, hysteresis: float, noise_sigma: float, *, from_rest: bool = False) -> None:
        self._is_sure = hysteresis >= SURE * noise_sigma
        self._since_switch = WIDTHS[0][0] if from_rest else 0
        self._latest: deque[float] = deque(maxlen=WIDTHS[0][1])

    def switched(self, relay: Relay, *, is_high: bool, pv: float) -> bool:
        """Return whether the output of a relay is high after one more reading."""
        now_high = relay.switched(is_high=is_high, pv=self.step(pv))
        if now_high != is_high:
            self._since_switch = 0
        return now_high

    def step(self, pv: float) -> float:
        """Take a reading; return the PV to decide by, PV units."""
        if self._is_sure:
            return pv
        self._latest.append(pv)
        self._since_switch += 1
        width = next((width for since, width in WIDTHS if self._since_switch > since), 1)
        latest = sorted(islice(reversed(self._latest), width))
        return latest[len(latest) // 2]
