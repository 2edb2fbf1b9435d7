"""The relay: two output levels and a dead zone on the PV.

For a direct process (a higher output raises the PV) with reference `r` and hysteresis `eps`:

    output = high   from the moment at which pv < r - eps
    output = low    from the moment at which pv > r + eps

and vice versa for a reverse process. `h = (high - low)/2` is the relay amplitude, HALF the swing, and
`bias = (high + low)/2` its centre (thesis eq. 3.3; Astrom and Hagglund, Automatica 20, 1984).

PV of the relay's decision: the median of the latest readings, where a single one may be noise.

    w = 1        where the dead zone is wide enough (`SURE` sigma), and shortly after a switch
        3, 5     after 30, 100 readings (`WIDTHS`)

With a dead zone of 3 sigma, one reading in 700 lies beyond it on one side. At rest, before the process has responded,
the relay waits there for a dead time, which at a high sampling rate is thousands of readings: noise alone would switch
it. Three readings of five lie beyond in one case of forty million. The cost is a switch that is (w - 1)/2 readings
late, at most 3 % of a half period; and a single wild reading switches nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import islice


@dataclass(frozen=True, slots=True)
class Relay:
    """A relay with hysteresis around a reference.

    Attributes
    ----------
    low, high : float
        The two output levels, output units.
    reference : float
        PV around which it switches, engineering units.
    hysteresis : float
        Half width of the dead zone, engineering units; 0 for the ideal relay.
    direct : bool
        Whether a higher output raises the PV.
    """

    low: float
    high: float
    reference: float
    hysteresis: float = 0.0
    direct: bool = True

    @property
    def amplitude(self) -> float:
        """Half the swing, output units."""
        return (self.high - self.low) / 2.0

    @property
    def bias(self) -> float:
        """The centre between the levels, output units."""
        return (self.high + self.low) / 2.0

    def switched(self, *, is_high: bool, pv: float) -> bool:
        """Return whether the output is high after seeing `pv`; inside the dead zone it stays as it is."""
        error = (pv - self.reference) if self.direct else (self.reference - pv)
        if error > self.hysteresis:
            return False
        if error < -self.hysteresis:
            return True
        return is_high

    def level(self, *, is_high: bool) -> float:
        """Return the output of that position, output units."""
        return self.high if is_high else self.low


@dataclass(frozen=True, slots=True)
class Levels:
    """Relay levels placed around the present output.

    Attributes
    ----------
    low, high : float
        Output levels inside the limits, output units.
    one_sided : bool
        The present output leaves no room on one side: the equilibrium under the present output is at an edge of the
        oscillation, so the PV reference must be moved off it.
    """

    low: float
    high: float
    one_sided: bool


ROOM_NEEDED = 0.15
"""Share of the swing that must lie on each side of the present output for it to serve as the operating point."""


def place_levels(output: float, amplitude: float, ratio: float, limits: tuple[float, float]) -> Levels | None:
    """Place a swing of `2 amplitude` around the present output, the upper part `ratio` times the lower.

    Asymmetry makes the mean of the output differ from its equilibrium, which identifies the static gain. When the
    requested placement exceeds a limit its mirror image is tried, then the swing is shifted inside the limits.

    Parameters
    ----------
    output : float
        Present output, output units.
    amplitude : float
        Half the swing, output units.
    ratio : float
        Upper part over lower part of the swing; 1 is symmetric.
    limits : tuple of float
        Lowest and highest output allowed.

    Returns
    -------
    Levels or None
        None when the limits are closer than the swing.
    """
    swing = 2.0 * amplitude
    lowest, highest = limits
    if swing > (highest - lowest) * (1.0 + 1e-12):
        return None
    for above in (swing * ratio / (1.0 + ratio), swing / (1.0 + ratio)):
        if output + above <= highest and output + above - swing >= lowest:
            return Levels(output + above - swing, output + above, one_sided=False)
    low = inside(output - swing / (1.0 + ratio), swing, limits)
    room = min(output - low, low + swing - output)
    return Levels(low, low + swing, one_sided=room < ROOM_NEEDED * swing)


def inside(low: float, swing: float, limits: tuple[float, float]) -> float:
    """Return the low level of a swing, moved as little as puts both levels inside the limits, output units."""
    return min(max(low, limits[0]), limits[1] - swing)


SURE = 4.5
"""Half width of a dead zone in standard deviations of the noise, from which a single reading is accepted."""
WIDTHS = ((100, 5), (30, 3))
"""Readings since the last switch, and of how many the median is then taken."""


class SwitchFilter:
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
