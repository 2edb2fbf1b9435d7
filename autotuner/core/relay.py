"""The relay: two output levels and a dead zone on the PV.

For a direct process (a higher output raises the PV) with reference `r` and hysteresis `eps`:

    output = high   from the moment at which pv < r - eps
    output = low    from the moment at which pv > r + eps

and the other way round for a reverse process. `h = (high - low)/2` is the relay amplitude, HALF the swing, and
`bias = (high + low)/2` its centre (thesis eq. 3.3; Astrom and Hagglund, Automatica 20, 1984).
"""

from __future__ import annotations

from dataclasses import dataclass


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

    Asymmetry makes the mean of the output differ from its equilibrium, which is what shows the static gain. When the
    wanted placement passes a limit its mirror image is tried, then the swing is pushed inside the limits.

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
    low = min(max(output - swing / (1.0 + ratio), lowest), highest - swing)
    room = min(output - low, low + swing - output)
    return Levels(low, low + swing, one_sided=room < ROOM_NEEDED * swing)
