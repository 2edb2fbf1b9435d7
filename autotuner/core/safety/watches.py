"""Watches of the supervisor over time and budgets: lateness, missing PV, duration, travel, energy.

    travel = sum |u_k - u_{k-1}|            output units
    energy = | int (u - u_0) dt |           output units x s, u_0 the output at the start

Invariant: a watch is small, keeps its own state, and returns a verdict or None for every sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict
    from autotuner.errors import AutotunerError


PROCESS_STALLED = "process_stalled"


@dataclass(frozen=True, slots=True)
class SampleContext:
    """One sample with its context.

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
    """Interface of a watch of the supervisor."""

    def check(self, context: SampleContext) -> Verdict | None:
        """Take a sample; return a verdict when its limit is passed."""


class LatenessWatch:
    """A sample must not be later than `limit_s`."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict for a late sample."""
        sample = context.sample
        if sample.lateness_s <= self._limit_s:
            return None
        return aborted(
            "sample_late",
            f"the sample of {sample.t:.3f} s came {sample.lateness_s:.3g} s late (limit {self._limit_s:g} s)",
            "Use a longer sample time, or a machine with less load.",
        )


class BlindnessWatch:
    """No more than `limit_s` may lie between two usable PVs.

    A pause of this program is reported as such, not as a lost sensor.

    While a computer sleeps, its clock may stand still too: that time is in no `t`, and counts all the same.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._seen_s: float | None = None
        self._still_s = 0.0

    def check_usable(
        self, t: float, *, usable: bool, still_s: float = 0.0, failure: AutotunerError | None = None
    ) -> Verdict | None:
        """Return a verdict after too long a time without a usable PV.

        No reading was possible for `still_s` of the time since the one before; `failure` is why this one failed.
        """
        silent_s = 0.0 if self._seen_s is None else t - self._seen_s
        still_s += self._still_s
        first, self._still_s = self._seen_s is None, 0.0 if usable else still_s
        if usable or first:
            self._seen_s = t
        if first or max(silent_s, still_s) <= self._limit_s:
            return None
        if still_s > self._limit_s or (silent_s - still_s <= self._limit_s and still_s >= silent_s / 2.0):
            return process_stalled(still_s, self._limit_s, t)
        lost = aborted(
            "pv_lost",
            f"no usable PV for {silent_s:.3g} s (limit {self._limit_s:g} s) at {t:.3f} s",
            "Check the sensor, its wiring and the link, then start again.",
        )
        return lost if failure is None else lost.because(failure.finding, failure.remedy)


def process_stalled(still_s: float, limit_s: float, t: float) -> Verdict:
    """Return the verdict of a tuning whose own program was stopped for `still_s`."""
    return aborted(
        "process_stalled",
        f"the program that drives the loop itself stood still for {still_s:.3g} s (a PV is needed every {limit_s:g} s) "
        f"at {t:.3f} s: it was paused, or the computer slept or gave it no time",
        "Keep the computer awake, and the program or its virtual machine from being paused, while a tuning runs; "
        "then start again.",
    )


class TimeWatch:
    """No phase, and not the whole, may last longer than its limit."""

    def __init__(self, total_s: float, phase_s: float) -> None:
        self._total_s = total_s
        self._phase_s = phase_s
        self._started_s: float | None = None
        self._entered_s = 0.0
        self._phase = ""

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when time is up."""
        t = context.sample.t
        self._started_s = t if self._started_s is None else self._started_s
        if context.phase != self._phase:
            self._phase, self._entered_s = context.phase, t
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

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when a budget is used up."""
        sample = context.sample
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
