"""The supervisor's watches over everything but the PV: who drives, how late, how long blind, what was spent.

    travel = sum |u_k - u_{k-1}|            output units
    energy = | int (u - u_0) dt |           output units x s, u_0 the output at the start

Rule of this file: a watch is small, remembers what it must, and answers every sample with a verdict or None.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

MODE_CHANGED = "mode_changed"
MODE_REFUSED = "mode_refused"
SAME_SET_POINT = 1e-6
"""Relative difference under which two set points are the same: what a 32-bit float in a register loses."""
RECENT = 4
FOLLOWS = 3.0
"""Samples back, and distance in mean steps of the PV, within which a new set point counts as one that follows it."""
DRIVEN, BEHIND = 20.0, 0.25
"""Range of the PV, in mean steps, from which it is clearly driven; distance, in that range, that is left behind."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One sample with what belongs to it.

    Attributes
    ----------
    sample : Sample
        What was read; its output is the one held until now.
    auto : float or None
        The device's mode bit, None when it has none.
    phase : str
        The phase in which it was taken.
    """

    sample: Sample
    auto: float | None = None
    phase: str = ""


class Watch(Protocol):
    """One thing that the supervisor watches."""

    def check(self, seen: Seen) -> Verdict | None:
        """Take a sample; return a verdict when its limit is passed."""


class ModeWatch:
    """The device must follow into manual within `patience_s`, and stay there."""

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._first_s: float | None = None
        self._manual_seen = False

    def check(self, seen: Seen) -> Verdict | None:
        """Return a verdict when the device's own controller drives the output."""
        t = seen.sample.t
        self._first_s = t if self._first_s is None else self._first_s
        if seen.auto is None or not seen.auto:
            self._manual_seen = self._manual_seen or seen.auto is not None
            return None
        if self._manual_seen:
            return aborted(
                MODE_CHANGED,
                f"the device went back to auto at {t:.3f} s while the tuning held it in manual",
                "Somebody took the loop over; start again when it is free.",
            )
        if t - self._first_s <= self._patience_s:  # it may take a scan or two to follow
            return None
        return aborted(
            MODE_REFUSED,
            f"the device is still in auto at {t:.3f} s, {t - self._first_s:.3g} s after it was told to go to manual "
            f"(limit {self._patience_s:g} s)",
            "Release the device for remote operation, or correct the mapping of auto.",
        )


class SetPointWatch:
    """The set point must stay where it was, unless it follows the PV, as that of many a controller in manual does.

    A new set point that is a PV of the last samples follows it, unless the set point was seen to stay behind before:
    away from all of these samples by a good part of the whole range of the PV.
    """

    def __init__(self) -> None:
        self._set_point = math.nan
        self._recent: deque[float] = deque(maxlen=RECENT)
        self._range = (math.inf, -math.inf)
        self._travel = 0.0
        self._steps = 0
        self._stays = False

    def check(self, seen: Seen) -> Verdict | None:
        """Return a verdict when somebody has changed the set point."""
        sample = seen.sample
        if math.isfinite(sample.pv):
            self._take(sample.pv)
        before, now = self._set_point, sample.set_point
        if not math.isfinite(now):
            return None
        self._set_point = now
        if math.isnan(before) or math.isclose(before, now, rel_tol=SAME_SET_POINT, abs_tol=1e-9):
            self._stays = self._stays or self._is_left_behind(now)
            return None
        if self._follows(now):
            return None
        return aborted(
            "set_point_changed",
            f"the set point went from {before:g} to {now:g} at {sample.t:.3f} s",
            "Somebody operates the loop; start again when it is free.",
        )

    def _take(self, pv: float) -> None:
        if self._recent:
            self._travel += abs(pv - self._recent[-1])
            self._steps += 1
        self._recent.append(pv)
        self._range = (min(self._range[0], pv), max(self._range[1], pv))

    @property
    def _step(self) -> float:
        return self._travel / max(self._steps, 1)

    def _distance(self, set_point: float) -> float:
        """Return how far it lies outside of the last PVs."""
        return max(min(self._recent) - set_point, set_point - max(self._recent), 0.0) if self._recent else 0.0

    def _is_left_behind(self, set_point: float) -> bool:
        span = self._range[1] - self._range[0]
        return span > DRIVEN * self._step and self._distance(set_point) > BEHIND * span

    def _follows(self, set_point: float) -> bool:
        return not self._stays and bool(self._recent) and self._distance(set_point) <= FOLLOWS * self._step


class LatenessWatch:
    """A sample must not be later than `limit_s`."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s

    def check(self, seen: Seen) -> Verdict | None:
        """Return a verdict when the sample came too late."""
        sample = seen.sample
        if sample.lateness_s <= self._limit_s:
            return None
        return aborted(
            "sample_late",
            f"the sample of {sample.t:.3f} s came {sample.lateness_s:.3g} s late (limit {self._limit_s:g} s)",
            "Use a longer sample time, or a machine with less load.",
        )


class BlindnessWatch:
    """No more than `limit_s` may lie between two usable PVs."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._seen_s: float | None = None

    def check_usable(self, t: float, *, usable: bool) -> Verdict | None:
        """Return a verdict when no usable PV has come for too long."""
        blind_s = 0.0 if self._seen_s is None else t - self._seen_s
        if usable or self._seen_s is None:
            self._seen_s = t
        if blind_s <= self._limit_s:
            return None
        return aborted(
            "pv_lost",
            f"no usable PV for {blind_s:.3g} s (limit {self._limit_s:g} s) at {t:.3f} s",
            "Check the sensor, its wiring and the link, then start again.",
        )


class TimeWatch:
    """No phase, and not the whole, may last longer than its limit."""

    def __init__(self, total_s: float, phase_s: float) -> None:
        self._total_s = total_s
        self._phase_s = phase_s
        self._started_s: float | None = None
        self._entered_s = 0.0
        self._phase = ""

    def check(self, seen: Seen) -> Verdict | None:
        """Return a verdict when time is up."""
        t = seen.sample.t
        self._started_s = t if self._started_s is None else self._started_s
        if seen.phase != self._phase:
            self._phase, self._entered_s = seen.phase, t
        if t - self._started_s > self._total_s:
            return _time_up("time_limit", "the tuning", t - self._started_s, self._total_s, t)
        if t - self._entered_s > self._phase_s:
            return _time_up("phase_time_limit", f"phase {self._phase}", t - self._entered_s, self._phase_s, t)
        return None


def _time_up(code: str, what: str, lasted_s: float, limit_s: float, t: float) -> Verdict:
    return aborted(
        code,
        f"{what} lasts {lasted_s:.4g} s (limit {limit_s:g} s) at {t:.3f} s",
        "Raise the limit, or use a larger amplitude so that fewer periods are needed.",
    )


class SpendingWatch:
    """Travel and energy must stay within their budgets."""

    def __init__(self, travel: float, energy: float) -> None:
        self._travel_limit = travel
        self._energy_limit = energy
        self._first: Sample | None = None
        self._last: Sample | None = None
        self._travel = 0.0
        self._energy = 0.0

    def check(self, seen: Seen) -> Verdict | None:
        """Return a verdict when a budget is used up."""
        sample = seen.sample
        self._first = self._first or sample
        if self._last is not None:
            self._travel += abs(sample.output - self._last.output)
            self._energy += (sample.output - self._first.output) * (sample.t - self._last.t)
        self._last = sample
        if self._travel > self._travel_limit:
            return aborted(
                "travel_limit",
                f"the output has travelled {self._travel:.4g} (limit {self._travel_limit:g}) at {sample.t:.3f} s",
                "Raise safety.travel, or use a smaller amplitude or fewer periods.",
            )
        if abs(self._energy) > self._energy_limit:
            return aborted(
                "energy_limit",
                f"the integral of the output beyond its start is {self._energy:+.4g} "
                f"(limit {self._energy_limit:g}) at {sample.t:.3f} s",
                "Raise safety.energy, or use a smaller amplitude.",
            )
        return None
