"""Whether the PV answers a push against the declared action, or only starts that way.

    clear = 10 hystereses,   moved = motion in the direction that the action declares, since rest

A process of the other sign goes on the wrong way or stays there; an inverse response turns back. So the first clear
move is watched for twice the time that it took to come about, and refused when it is not back by then; one that goes
on to twice `clear` is refused at once, which bounds what the watching can cost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core import refusals

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.rested import Rested
    from autotuner.core.verdict import Verdict

CLEAR = 10.0
"""Move of the PV against the declared action that counts, in hystereses."""
TOO_FAR = 2.0
"""Such a move that is refused at once, in clear ones."""
TURNING = 2.0
"""Time that the PV is given to come back, in the time that it took to move so far."""


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

    def step(self, sample: Sample, *, is_high: bool) -> Verdict | None:
        """Return a refusal when the push to one level moves the PV against the declared action for good."""
        rested = self._rested
        moved = (sample.pv - rested.quiet.pv) * (1.0 if is_high == rested.settings.direct else -1.0)
        clear = max(CLEAR * max(rested.hysteresis, rested.quiet.noise_sigma), rested.perceptible)
        if moved >= -clear:
            return None
        if self._seen_s is None:
            self._seen_s = sample.t
        turning_s = TURNING * (self._seen_s - self._started_s)
        if moved > -TOO_FAR * clear and sample.t - self._seen_s < turning_s:
            return None
        level = rested.levels.high if is_high else rested.levels.low
        return refusals.wrong_way(-moved, level, direct=rested.settings.direct)
