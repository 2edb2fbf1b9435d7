"""Whether the PV answers a push against the declared action, or only starts that way.

    clear = 10 hystereses,   moved = motion in the direction that the action declares, since rest

A process of the other sign goes on the wrong way or stays there; an inverse response turns back. So the first clear
move is watched for twice the time that it took to come about, and refused when it is not back by then; one that goes
on to twice `clear` is refused at once, which bounds what the watching can cost. What is refused may still be an inverse
response that goes too far, or takes too long to turn; the advice says so where the PV was seen to do what one does:

    turned     largest - last > 4 noises                  it is on its way back
    slowing    way in the second half + 4 noises < half the way in the first half, of the time since clear/2
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core import refusals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.recording import Sample
    from autotuner.core.rested import Rested
    from autotuner.core.verdict import Verdict

CLEAR = 10.0
"""Move of the PV against the declared action that counts, in hystereses."""
TOO_FAR = 2.0
"""Such a move that is refused at once, in clear ones."""
TURNING = 2.0
"""Time that the PV is given to come back, in the time that it took to move so far."""
CERTAIN = 4.0
"""Noise that a difference must exceed, in standard deviations."""
SLOWING = 0.5
"""Speed of the second half of the way, in that of the first, under which a PV may be about to turn."""
ROUNDING = 1e-3
"""Share of its way that a PV without noise must have come back."""
FEWEST = 4
"""Samples from which two speeds can be told."""


class WrongWay:
    """Watches a push that began at `started_s`.

    Parameters
    ----------
    rested : Rested
        The loop at rest.
    started_s : float
        Time of the push, s.
    """

    def __init__(self, rested: Rested, started_s: float) -> None:
        self._rested = rested
        self._started_s = started_s
        self._seen_s: float | None = None
        self._away: list[float] = []

    def step(self, sample: Sample, *, is_high: bool) -> Verdict | None:
        """Return a refusal when the push to one level moves the PV against the declared action for good."""
        rested = self._rested
        moved = (sample.pv - rested.quiet.pv) * (1.0 if is_high == rested.settings.direct else -1.0)
        clear = max(CLEAR * max(rested.hysteresis, rested.quiet.noise_sigma), rested.perceptible)
        if moved < -clear / 2.0:
            self._away.append(-moved)
        if moved >= -clear:
            return None
        if self._seen_s is None:
            self._seen_s = sample.t
        turning_s = TURNING * (self._seen_s - self._started_s)
        if moved > -TOO_FAR * clear and sample.t - self._seen_s < turning_s:
            return None
        level = rested.levels.high if is_high else rested.levels.low
        verdict = refusals.wrong_way(-moved, level, direct=rested.settings.direct)
        if inverse := inverse_sign(self._away, rested.quiet.noise_sigma):
            # so that a push with the same dip would pass the watch, with a quarter to spare
            verdict = refusals.perhaps_inverse(verdict, inverse, 1.25 * max(self._away) / CLEAR)
        return verdict


def inverse_sign(away: Sequence[float], noise_sigma: float) -> str:
    """Return in what a PV that went the wrong way does as an inverse response would, in words; empty when in nothing.

    Parameters
    ----------
    away : sequence of float
        How far it was from rest in each sample of its way, PV units.
    noise_sigma : float
        Its noise.
    """
    certain, half = CERTAIN * noise_sigma, len(away) // 2
    if half < FEWEST:
        return ""
    if max(away) - away[-1] > max(certain, ROUNDING * max(away)):
        return "has turned and is on its way back"
    first, second = away[half] - away[0], away[-1] - away[len(away) - 1 - half]
    return "slows down on its way" if second + certain < SLOWING * first else ""
