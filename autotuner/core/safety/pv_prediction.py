"""Prediction of the PV one reaction time ahead.

    pv(t + lead) = level + slope * lead

level, slope   of a least-squares line through the latest samples, with their standard errors: the prediction counts
               only as far as it is certain (`CERTAIN` standard errors), so that noise near a limit does not trip
               (`latest`)
lead           overrun / slope at the turn, s: the travel of the PV after the output had turned, over its slope at
               that time. For a first-order process with dead time it is T (1 - e^{-D/T}), everywhere on its curve.

Before the first turn of the PV, the time from the first move of the output to the first clear response of the PV
replaces the lead, limited to the time for which the PV has been moving: for a process that settles, the prediction then
exceeds its final value by 14 % at most (the largest value of 1 - e^{-x} + x e^{-x}), and by the lag of the line.

After the output has turned, the PV continues by its overrun, which no action can prevent: for the usual time
until the PV turns, its motion in that direction is not a violation.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from autotuner.core.signals.output_reversals import Moves
from autotuner.core.signals.windowed_trend import MOST, Latest
from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    from autotuner.core.safety.watches import SampleContext
    from autotuner.core.signals.windowed_trend import Trend
    from autotuner.core.verdict import Verdict

FEWEST = 8
"""Fewest samples in the line."""
WINDOW = 0.5
"""Length of the line, in leads."""
ANSWERED = 4.0
"""Standard deviations of the PV at rest by which it must have moved to count as an answer."""
TURNING = 1.5
"""Time that the PV is given to turn, in the time it took before."""
FLATTEST = 0.3
"""Smallest slope at the turn of the output from which a lead is learned, in the steepest slope seen."""
STEEPEST = 2.0
"""Largest mean slope between the turn of the output and of the PV that is accepted, in slopes at the turn."""


class Turn:
    """The PV after a turn of the output: its motion, and its furthest value.

    Attributes
    ----------
    direction : float
        The direction in which the PV was moving, 0 while the noise hides it.
    """

    def __init__(self, started_s: float, trend: Trend) -> None:
        self.direction = 0.0
        self._started_s = started_s
        self._trend = trend
        self._furthest = trend.level
        self._furthest_s = started_s

    def follow(self, t: float, trend: Trend) -> None:
        """Record the furthest value."""
        self.direction = self.direction or trend.direction
        if self.direction * (trend.level - self._furthest) > 0.0:
            self._furthest, self._furthest_s = trend.level, t

    def learned(self, steepest: float) -> tuple[float, float] | None:
        """Return lead and time from the turn of the output to the turn of the PV, s; None when they are unknown.

        `steepest` is the steepest slope of the PV so far: a much flatter one predicts little.
        """
        overrun, slope = self.direction * (self._furthest - self._trend.level), abs(self._trend.slope)
        if self._trend.direction == 0.0 or overrun <= 0.0 or slope < FLATTEST * steepest:
            return None
        lasted_s = self._furthest_s - self._started_s
        return min(overrun / slope, STEEPEST * lasted_s), lasted_s

    def lasts(self, t: float, limit_s: float) -> bool:
        """Return whether the output turned less than `limit_s` ago."""
        return t - self._started_s < limit_s


class Reaction:
    """Reaction of the process so far; see the head of this module."""

    def __init__(self) -> None:
        self._moves = Moves()
        self._rest: deque[float] = deque(maxlen=MOST)
        self._answered_s: float | None = None
        self._direction = 0.0
        self._since_s = 0.0
        self._steepest = 0.0
        self._turn: Turn | None = None
        self._leads_s: dict[float, float] = {}
        self._turning_s: dict[float, float] = {}

    def step(self, t: float, output: float, pv: float, trend: Trend) -> None:
        """Take a sample with the line that ends in it."""
        turned = self._moves.step(t, output)
        if self._moves.first_s is None:
            self._rest.append(pv)
            return
        if turned and self._moves.turns > 1:
            self._learn()
            self._turn = Turn(self._moves.turned_s, trend)
        if self._turn is not None:
            self._turn.follow(t, trend)
        self._answer(t, trend)

    def lead_s(self, t: float, direction: float) -> float | None:
        """Return the prediction horizon for a PV that moves in `direction`, s; None without any information."""
        if self._leads_s:
            return self._leads_s.get(direction, max(self._leads_s.values()))
        return None if self._answered_s is None else min(self._answered_s, t - self._since_s)

    def is_turning(self, t: float, direction: float) -> bool:
        """Return whether the PV still moves on because the output turned a short time ago."""
        turn = self._turn
        if turn is None or turn.direction != direction:
            return False
        known_s = self._turning_s.get(direction, 2.0 * (self._answered_s or math.inf))
        return turn.lasts(t, TURNING * known_s)

    def _learn(self) -> None:
        learned = self._turn.learned(self._steepest) if self._turn is not None else None
        if self._turn is not None and learned is not None:
            self._leads_s[self._turn.direction], self._turning_s[self._turn.direction] = learned

    def _answer(self, t: float, trend: Trend) -> None:
        """Record the first clear response, the time since which the PV moves in this direction, and its slope."""
        if trend.direction not in {0.0, self._direction}:
            self._direction, self._since_s = trend.direction, t
        self._steepest = max(self._steepest, abs(trend.slope)) if trend.direction else self._steepest
        if self._answered_s is not None or trend.direction == 0.0 or self._moves.first_s is None:
            return
        rest = self._rest or (trend.level,)
        start = sum(rest) / len(rest)
        noise = math.sqrt(sum((pv - start) ** 2 for pv in rest) / len(rest))
        if abs(trend.level - start) > ANSWERED * noise:
            self._answered_s = t - self._moves.first_s


class PvWatch:
    """The PV must be within its limits, and must not be heading out of them.

    Parameters
    ----------
    limits : tuple of float
        Lowest and highest PV, PV units.
    """

    def __init__(self, limits: tuple[float, float]) -> None:
        self._limits = limits
        self._limited = any(map(math.isfinite, limits))
        self._latest = Latest()
        self._reaction = Reaction()

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when the PV is outside, or will be before a withdrawn output can act."""
        if not self._limited:
            return None
        sample, (low, high) = context.sample, self._limits
        self._latest.take(sample.t, sample.pv)
        trend = self._trend(sample.t)
        if trend is not None:
            self._reaction.step(sample.t, sample.output, sample.pv, trend)
        if not low <= sample.pv <= high:
            return _outside("pv_limit", "the PV is", sample.pv, sample.t, self._limits)
        reached = None if trend is None else self._foreseen(sample.t, trend)
        if reached is None or low <= reached <= high:
            return None
        return _outside(
            "pv_limit_predicted", f"the PV at {sample.pv:.5g} is heading for", reached, sample.t, self._limits
        )

    def _trend(self, t: float) -> Trend | None:
        if self._latest.size < FEWEST:
            return None
        return self._latest.trend(t - WINDOW * (self._reaction.lead_s(t, 0.0) or 0.0), FEWEST)

    def _foreseen(self, t: float, trend: Trend) -> float | None:
        direction = trend.direction
        lead_s = self._reaction.lead_s(t, direction)
        if direction == 0.0 or lead_s is None or self._reaction.is_turning(t, direction):
            return None
        reached = trend.ahead(lead_s, direction)
        return reached if direction * (reached - trend.level) > 0.0 else None


def _outside(code: str, what: str, value: float, t: float, limits: tuple[float, float]) -> Verdict:
    return aborted(
        code,
        f"{what} {value:.5g}, outside {limits[0]:g} to {limits[1]:g}, at {t:.3f} s",
        "Lower the relay amplitude, start further from the limit, or widen limits.pv.",
    )
