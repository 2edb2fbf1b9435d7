"""Action check: distinguishes a process of the opposite action from an inverse response.

    clear = 10 hystereses,   moved = motion in the direction that the action declares, since rest

A process of the opposite action continues in the wrong direction or stays there; an inverse response returns. The first
clear move is therefore observed for the quiet time (50 samples by default), and at least twice the duration of the
move. A PV that slows down is given twice as long, one that has turned four times. These times, and half the distance
to a PV limit, bound the cost. Where the user has given a hysteresis, and thus a
scale, a move of twice `clear` is refused at once, and so is one that has not returned after twice its duration.
A refused response may still be an inverse response; the advice states that where the PV behaved like one:

    turned     largest - last > 4 noises                  the PV returns
    slowing    move in the second half + 4 noises < half the move in the first half, of the time since clear/2
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.experiment import refusals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.experiment.relay_phase.operating_point import OperatingPoint
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

CLEAR = 10.0
"""Move of the PV against the declared action that counts, in hystereses."""
TOO_FAR = 2.0
"""Such a move that is refused at once, in clear ones."""
TURNING = 2.0
"""Time for the PV to return, as a multiple of the duration of its move."""
CERTAIN = 4.0
"""Noise that a difference must exceed, in standard deviations."""
PATIENCE = {"": 1.0, "slows down on its way": 2.0, "has turned and is on its way back": 4.0}
"""Observation time by the behaviour of the PV, as a multiple of the basic one."""
TO_LIMIT = 0.5
"""Largest move against the declared action, as a share of the distance to the PV limit on that side."""
SLOWING = 0.5
"""Ratio of the speeds of the second and the first half of a move below which a PV may be about to turn."""
ROUNDING = 1e-3
"""Share of its move that a PV without noise must have returned."""
FEWEST = 4
"""Samples from which two speeds can be determined."""


class ActionCheck:
    """Watches a push that began at `started_s`.

    Parameters
    ----------
    rested : OperatingPoint
        The loop at rest.
    started_s : float
        Time of the push, s.
    """

    def __init__(self, rested: OperatingPoint, started_s: float) -> None:
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
        if not self._is_too_far(-moved, clear, sample) and self._may_turn(sample.t):
            return None
        level = rested.levels.high if is_high else rested.levels.low
        verdict = refusals.wrong_way(-moved, level, direct=rested.settings.direct)
        if inverse := inverse_sign(self._away, rested.quiet.noise_sigma):
            # so that a push with the same dip would pass the watch, with a quarter to spare
            verdict = refusals.perhaps_inverse(verdict, inverse, 1.25 * max(self._away) / CLEAR)
        return verdict

    def _is_too_far(self, moved: float, clear: float, sample: Sample) -> bool:
        """Return whether a move against the declared action is refused whatever it does next."""
        settings = self._rested.settings
        if settings.hysteresis is not None:
            return moved >= TOO_FAR * clear
        low, high = settings.limits.pv
        at_rest = self._rested.quiet.pv
        return moved > TO_LIMIT * (high - at_rest if sample.pv > at_rest else at_rest - low)

    def _may_turn(self, t: float) -> bool:
        """Return whether the PV still has time to return."""
        assert self._seen_s is not None  # noqa: S101 - narrows the type
        settings, watched_s = self._rested.settings, t - self._seen_s
        allowance_s = TURNING * (self._seen_s - self._started_s)
        if settings.hysteresis is not None:
            return watched_s < allowance_s
        allowance_s = max(allowance_s, settings.quiet_duration_s)
        if watched_s < allowance_s:
            return True
        if watched_s >= max(PATIENCE.values()) * allowance_s:
            return False
        return watched_s < PATIENCE[inverse_sign(self._away, self._rested.quiet.noise_sigma)] * allowance_s


def inverse_sign(away: Sequence[float], noise_sigma: float) -> str:
    """Return the behaviour of a PV in the wrong direction that indicates an inverse response, in words; or empty.

    Parameters
    ----------
    away : sequence of float
        Distance from rest in each sample of the move, PV units.
    noise_sigma : float
        Standard deviation of its noise.
    """
    certain, half = CERTAIN * noise_sigma, len(away) // 2
    if half < FEWEST:
        return ""
    if max(away) - away[-1] > max(certain, ROUNDING * max(away)):
        return "has turned and is on its way back"
    first, second = away[half] - away[0], away[-1] - away[len(away) - 1 - half]
    return "slows down on its way" if second + certain < SLOWING * first else ""
