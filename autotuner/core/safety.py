"""The safety supervisor: asked before every write, independent of the experiment.

    u_k in [lowest, highest],   |u_k - u_{k-1}| <= slew (t_k - t_{k-1})
    pv_{k+lead} = pv_k + lead * slope,   slope over the last `SLOPE_SAMPLES` samples

`lead` is the reaction time that has been seen (the time from a switch to the turn of the PV), so the predicted PV is
where the process will be when a withdrawn output begins to act. It is compared with the limits only while it moves
towards them.

Rules of this file:

1. A limit is never exceeded "for a moment"; `permit` is the only way to an output.
2. A trip is a verdict that names the limit, the value and the time. It does not act: the controller restores.
3. A sensor that says nothing useful (NaN, no answer) is tolerated for `blind_s` only, however it fails.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.verdict import Verdict, aborted

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.settings import Limits

SLOPE_SAMPLES = 8
"""Samples over which the slope of the PV is taken: short against a half period, long enough to average noise."""
MODE_CHANGED = "mode_changed"
"""Code of the trip after which nothing is restored: somebody else drives the loop."""


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """What the supervisor watches beside the limits.

    Attributes
    ----------
    blind_s : float
        Longest time without a usable PV, s.
    late_s : float
        Largest lateness of a sample, s.
    """

    blind_s: float
    late_s: float


class Supervisor:
    """Watches one tuning.

    Parameters
    ----------
    limits : Limits
        Output, slew and PV limits.
    settings : SafetySettings
        Blindness and lateness.
    """

    def __init__(self, limits: Limits, settings: SafetySettings) -> None:
        self._limits = limits
        self._settings = settings
        self._recent: deque[tuple[float, float]] = deque(maxlen=SLOPE_SAMPLES)
        self._seen_s: float | None = None
        self._switched_s: float | None = None
        self._lead_s = 0.0
        self._last_output: float | None = None
        self._manual_seen = False

    def permit(self, output: float, held: float, dt_s: float) -> float:
        """Return the output nearest to the wanted one that limits and slew allow.

        Parameters
        ----------
        output : float
            Wanted output, output units; NaN holds the present one.
        held : float
            Output held so far, output units.
        dt_s : float
            Time since the last change, s.
        """
        wanted = held if math.isnan(output) else output
        travel = self._limits.output_slew_per_s * dt_s
        low, high = self._limits.output
        near = min(max(wanted, held - travel), held + travel) if math.isfinite(travel) else wanted
        return min(max(near, low), high)

    def check(self, sample: Sample, *, auto: float | None = None) -> Verdict | None:
        """Return a verdict when a limit is passed by this sample, or will be before the output can act.

        `auto` is the device's mode bit, None when it has none: once seen in manual it must stay there.
        """
        self._seen_s = sample.t if self._seen_s is None else self._seen_s
        return (
            self._check_mode(sample.t, auto)
            or self._check_lateness(sample)
            or self.check_blindness(sample.t, usable=math.isfinite(sample.pv))
            or self._check_pv(sample)
        )

    def check_blindness(self, t: float, *, usable: bool) -> Verdict | None:
        """Return a verdict when no usable PV has come for too long."""
        if usable or self._seen_s is None:
            self._seen_s = t
            return None
        blind_s = t - self._seen_s
        if blind_s <= self._settings.blind_s:
            return None
        return aborted(
            "pv_lost",
            f"no usable PV for {blind_s:.3g} s (limit {self._settings.blind_s:g} s)",
            "Check the sensor, its wiring and the link, then start again.",
        )

    def _check_mode(self, t: float, auto: float | None) -> Verdict | None:
        if auto is None or not auto:
            self._manual_seen = self._manual_seen or auto is not None
            return None
        if not self._manual_seen:  # the device may take a scan or two to follow the switch to manual
            return None
        return aborted(
            MODE_CHANGED,
            f"the device went back to auto at {t:.3f} s while the tuning held it in manual",
            "Somebody took the loop over; start again when it is free.",
        )

    def _check_lateness(self, sample: Sample) -> Verdict | None:
        if sample.lateness_s <= self._settings.late_s:
            return None
        return aborted(
            "sample_late",
            f"a sample came {sample.lateness_s:.3g} s late (limit {self._settings.late_s:g} s)",
            "Use a longer sample time, or a machine with less load.",
        )

    def _check_pv(self, sample: Sample) -> Verdict | None:
        if not math.isfinite(sample.pv):
            return None
        self._learn_lead(sample)
        low, high = self._limits.pv
        if not low <= sample.pv <= high:
            return _out_of_range("pv_limit", "the PV is", sample.pv, sample.t, self._limits.pv)
        predicted = sample.pv + self._lead_s * self._slope()
        if not low <= predicted <= high:
            what = f"the PV at {sample.pv:.5g} is heading for"
            return _out_of_range("pv_limit_predicted", what, predicted, sample.t, self._limits.pv)
        return None

    def _learn_lead(self, sample: Sample) -> None:
        """Take the time from the last change of output to the turn of the PV as the lead: one dead time."""
        if self._last_output is not None and sample.output != self._last_output:
            self._switched_s = sample.t
        self._last_output = sample.output
        before = self._slope()
        self._recent.append((sample.t, sample.pv))
        if self._switched_s is not None and before * self._slope() < 0.0:
            self._lead_s, self._switched_s = sample.t - self._switched_s, None

    def _slope(self) -> float:
        if len(self._recent) < 2:
            return 0.0
        (t0, y0), (t1, y1) = self._recent[0], self._recent[-1]
        return (y1 - y0) / (t1 - t0) if t1 > t0 else 0.0


def _out_of_range(code: str, what: str, value: float, t: float, limits: tuple[float, float]) -> Verdict:
    return aborted(
        code,
        f"{what} {value:.5g}, outside {limits[0]:g} to {limits[1]:g}, at {t:.3f} s",
        "Lower the relay amplitude, start further from the limit, or widen limits.pv.",
    )
