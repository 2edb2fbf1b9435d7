"""Ownership watch of the supervisor: the device's mode, and its set point.

Both are read with every sample, and a reading may be damaged: a flipped bit, a zero, NaN. A reading that
indicates an operator's action is therefore doubtful until the next one confirms it. A doubtful sample causes no write,
neither because of a damaged reading nor against an operator who has just taken over.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    from autotuner.core.safety.watches import SampleContext
    from autotuner.core.verdict import Verdict

MODE_CHANGED = "mode_changed"
MODE_REFUSED = "mode_refused"
RARE = 20
"""Readings since the last damaged one after which another one may be damaged: two closer together are no accident."""
SAME_SET_POINT = 1e-6
"""Relative difference below which two set points are equal: the rounding of a 32-bit float in a register."""
RECENT = 4
"""Outputs written last that a reading may still show: the delays of a device with a slow scan."""
FOLLOWS = 3.0
"""Samples back, and distance in mean steps of the PV, within which a new set point counts as one that follows it."""
DRIVEN, BEHIND = 20.0, 0.25
"""Range of the PV, in mean steps, from which it is clearly driven; distance, in that range, that is lag."""


class Doubt:
    """A deviation in one reading of a signal, which counts when the next reading confirms it.

    Attributes
    ----------
    pending : str
        The reason of the last reading, while it waits for the next one; empty else.
    damaged : list of str
        Reasons that the next reading did not confirm.
    """

    def __init__(self) -> None:
        self.pending = ""
        self.damaged: list[str] = []
        self._since_damaged = RARE

    def settle(self, found: Verdict | None) -> Verdict | None:
        """Take the reason of a reading; return it when it is confirmed."""
        self._since_damaged += 1
        if found is not None and (self.pending or self._since_damaged <= RARE):
            return found
        if found is None and self.pending:
            self.damaged.append(self.pending)
            self._since_damaged = 0
        self.pending = "" if found is None else found.message
        return None


class ModeWatch:
    """The device must follow into manual within `patience_s`, and stay there."""

    def __init__(self, patience_s: float) -> None:
        self.doubt = Doubt()
        self._patience_s = patience_s
        self._first_s: float | None = None
        self._manual_seen = False

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when the device's own controller drives the output, or may do so."""
        t, auto = context.sample.t, context.auto
        self._first_s = t if self._first_s is None else self._first_s
        if auto is None:
            return None
        if auto and not self._manual_seen:
            return self._not_followed(t, t - self._first_s)
        self._manual_seen = True
        return self.doubt.settle(self._taken(t, auto) if auto else None)

    def _not_followed(self, t: float, waited_s: float) -> Verdict | None:
        if waited_s <= self._patience_s:  # it may take a scan or two to follow
            return None
        return aborted(
            MODE_REFUSED,
            f"the device is still in auto at {t:.3f} s, {waited_s:.3g} s after manual was written "
            f"(limit {self._patience_s:g} s)",
            "Release the device for remote operation, or correct the mapping of auto.",
        )

    def _taken(self, t: float, auto: float) -> Verdict:
        if math.isnan(auto):
            return aborted(
                "mode_unknown",
                f"the device does not report its mode at {t:.3f} s while the tuning held it in manual",
                "Check the device and the mapping of auto, then start again.",
            )
        return aborted(
            MODE_CHANGED,
            f"the device went back to auto at {t:.3f} s while the tuning held it in manual",
            "An operator or another program took the loop over; start again when it is free.",
        )


class SetPointWatch:
    """The set point must stay where it was, unless it follows the PV, as that of many a controller in manual does.

    A new set point that is a PV of the last samples follows it, unless the set point was seen to lag before:
    away from all of these samples by a good part of the whole range of the PV.
    """

    def __init__(self) -> None:
        self.doubt = Doubt()
        self._set_point = math.nan
        self._recent: deque[float] = deque(maxlen=RECENT)
        self._range = (math.inf, -math.inf)
        self._travel = 0.0
        self._steps = 0
        self._stays = False
        self._readings = 0
        self._sure = False

    def check(self, context: SampleContext) -> Verdict | None:
        """Return a verdict when the set point was changed by others."""
        sample = context.sample
        if math.isfinite(sample.pv):
            self._take(sample.pv)
        if not math.isfinite(sample.set_point):
            return self.doubt.settle(None)
        found = self._changed(sample.t, self._set_point, sample.set_point)
        self._readings += 1
        if found is not None and not self._sure and self._readings <= RECENT:
            self._set_point = sample.set_point  # the reading before may have been the damaged one
            return None
        if found is None:
            self._sure = self._sure or self._readings > 1
            self._set_point = sample.set_point
        return self.doubt.settle(found)

    def _changed(self, t: float, before: float, now: float) -> Verdict | None:
        if math.isnan(before) or math.isclose(before, now, rel_tol=SAME_SET_POINT, abs_tol=1e-9):
            self._stays = self._stays or self._is_left_behind(now)
            return None
        if self._follows(now):
            return None
        return aborted(
            "set_point_changed",
            f"the set point went from {before:g} to {now:g} at {t:.3f} s",
            "An operator or another program drives the loop; start again when it is free.",
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
