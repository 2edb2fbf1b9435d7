"""Judges a window of normal operation against the expected behaviour.

    error    = rms(pv - simulated)    the model on the output as it was, offset and beginning fitted
    process  = least squares on the window, where the set point moved enough to show it
    cause of an oscillation           friction by name; the loop's own period; else something from outside

Invariants:

1. A disturbance of the PV alone never leads to advice to tune again: that requires a process outside of its
   intervals, or a loop that oscillates on its own.
2. A process is identified only where the set point moved: the response of a controller to a disturbance is not an
   experiment, and a model of it would be biased.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner.core.design import margins, ultimate_point
from autotuner.core.estimation.simulation import simulate_fit
from autotuner.core.identification import identify
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.monitoring.changes import Change, Expected, Findings
from autotuner.core.monitoring.friction import error_beside_wave, likeliest_friction
from autotuner.core.monitoring.oscillation import Oscillation, oscillation_of
from autotuner.core.signals.noise import noise_sigma, rms
from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

VISIBLE = 2.0
"""Ratio of the error to the noise from which the behaviour counts as unexpected."""
MOVED = 8.0
"""Smallest excitation of PV or set point over the noise."""
EXPLAINED, MOSTLY = 0.7, 0.4
"""Ratio of the error with friction to that of the next best, and of the error of the new process to that of the
expected one, below which each is an explanation: a window with friction has a fitted process too."""
NOTHING_LEFT, CLEARLY = 1.1, 0.95
"""Ratios of the error to the noise, and to the previous error, of a clearly better process without remaining error."""
RELEVANT = 0.15
"""Relative change of a parameter that matters to a controller."""
ROBUST_MS, MUCH_LESS = 2.0, 1.5
"""Sensitivity, and its ratio to the expected one, above which a retune is advised, whatever the goal was."""
OWN = (0.5, 1.8)
"""Ratio of the period to the ultimate one at which a loop oscillates on its own; other causes are slower."""
SETTLING = 5
"""Share, as a divisor, of the time after a set-point move that is reserved for the response."""
SHAPE = 50.0
"""Samples in a period that show the shape of an oscillation."""


class _Found(NamedTuple):
    model: ProcessModel
    process: dict[str, Change]
    error: float


def findings(recording: Recording, expected: Expected) -> Findings:
    """Return the judgement of a loop from a window of normal running.

    Parameters
    ----------
    recording : Recording
        Output, PV and set point in normal running, under the device's own controller.
    expected : Expected
        What the loop was left with.
    """
    sigma = noise_sigma(recording.pv)
    steady = undisturbed(recording)
    oscillation = oscillation_of(steady.t, control_error(steady))
    if oscillation is not None and oscillation.amplitude < VISIBLE * sigma:
        oscillation = None
    missed = _error(recording, expected.model)
    if oscillation is None and np.ptp(_smooth(recording.pv)) < MOVED * sigma:
        message = "The PV stayed within its noise: nothing moved that could show a change."
        return Findings("at_rest", message, "", missed, sigma, None, {}, None, {}, ())
    found = _found(recording, expected.model) if _moved(recording, sigma) else None
    notes = () if found else ("the set point did not move enough to show K, T and D",)
    window = _JudgedWindow(recording, steady, expected, sigma, missed, oscillation, found, notes)
    ways = (window.sticking, window.changed, window.hunting, window.disturbed)
    return next((finding for check in ways if (finding := check()) is not None), window.fine())


def undisturbed(recording: Recording) -> Recording:
    """Return the longest part with a constant set point, without the response to the previous move."""
    if recording.set_point is None:
        return recording
    moves = np.flatnonzero(np.diff(np.nan_to_num(recording.set_point)) != 0.0) + 1
    edges = np.concatenate(([0], moves, [len(recording)]))
    longest = len(edges) - 2 - int(np.argmax(np.diff(edges)[::-1]))  # the last one of equals
    first, end = int(edges[longest]), int(edges[longest + 1])
    settled = first + (end - first) // SETTLING if first else 0
    return recording.part(slice(settled, end)) if end - settled > 1 else recording


def control_error(recording: Recording) -> FloatArray:
    """Return PV minus set point; where the loop is open, or its set point is not known, the PV about its mean."""
    centred: FloatArray = recording.pv - np.mean(recording.pv)
    if recording.set_point is None:
        return centred
    return np.where(np.isfinite(recording.set_point), recording.pv - recording.set_point, centred)


@dataclass(frozen=True, slots=True)
class _JudgedWindow:
    recording: Recording
    steady: Recording
    expected: Expected
    sigma: float
    missed: float
    oscillation: Oscillation | None
    found: _Found | None
    notes: tuple[str, ...]

    def sticking(self) -> Findings | None:
        """Return an oscillation that friction makes."""
        effects = self._friction() if self.oscillation else {}
        if not effects or self.oscillation is None:
            return None
        sizes = "; ".join(
            f"{name} " + ", ".join(f"{part} {value:.3g}" for part, value in sizes.items())
            for name, sizes in effects.items()
        )
        message = f"The loop oscillates with {self._swing()}, and the record shows friction of the actuator: {sizes}."
        remedy = "Have valve and positioner serviced; other gains change the period, not the cause."
        return self._finding("valve_sticking", message, remedy, effects)

    def changed(self) -> Findings | None:
        """Return a process that is another one, or on which the gains are no more robust."""
        if self.found is None or not self._explains(self.found.error):
            return None
        others = [name for name, change in self.found.process.items() if self._is_another(name, change)]
        sensitivity = self._sensitivity()
        if not others and not _lost(sensitivity):
            return None
        message = "; ".join(_words(name, self.found.process[name]) for name in others) or "the gains are less robust"
        message += "" if sensitivity is None else f"; Ms is {_ms(sensitivity[1])} instead of {_ms(sensitivity[0])}"
        return self._finding("retune_advised", f"The process has changed: {message}.", "Tune the loop again.")

    def hunting(self) -> Findings | None:
        """Return an oscillation with the loop's own period."""
        if self.oscillation is None:
            return None
        own_s = self._own_s
        if own_s is None or not OWN[0] * own_s <= self.oscillation.period_s <= OWN[1] * own_s:
            return None
        message = f"The loop hunts: it oscillates with {self._swing()}, near its ultimate period of {own_s:.3g} s."
        return self._finding("retune_advised", message, "Lower the gain by a third at once; then tune the loop again.")

    def disturbed(self) -> Findings | None:
        """Return the finding of an external disturbance."""
        if self.oscillation is not None:
            message = (
                f"The PV oscillates with {self._swing()}, which is not the loop's own period, and shows no friction."
            )
            return self._finding(
                "disturbed", message, "Search for a source with this period: a neighbouring loop, a pump."
            )
        if self.missed < VISIBLE * self.sigma:
            return None
        times = self.missed / max(self.sigma, SMALLEST_DIVISOR)
        message = f"The model does not explain the PV: {times:.3g} times the noise."
        return self._finding(
            "disturbed", message, "None, if loads of this size are usual; a set-point step would show more."
        )

    def fine(self) -> Findings:
        """Return the finding of a loop that behaves as expected."""
        message = f"Measured and expected PV differ by {self.missed:.3g}, the noise is {self.sigma:.3g}."
        return self._finding("as_expected", message, "")

    def _finding(
        self, code: str, message: str, remedy: str, effects: Mapping[str, Mapping[str, float]] | None = None
    ) -> Findings:
        process = self.found.process if self.found else {}
        return Findings(
            code, message, remedy, self.missed, self.sigma, self.oscillation, process, self._sensitivity(),
            effects or {}, self.notes,
        )  # fmt: skip

    def _swing(self) -> str:
        assert self.oscillation is not None  # noqa: S101 - checked by the caller
        return f"a period of {self.oscillation.period_s:.3g} s and an amplitude of {self.oscillation.amplitude:.3g}"

    def _explains(self, error: float) -> bool:
        """Return whether a process explains most of the misfit, or, where that is small, all but the noise."""
        nothing_left = NOTHING_LEFT * self.sigma
        if self.oscillation is not None:  # what drives a wave fits many a process
            return error <= min(nothing_left, CLEARLY * self.missed)
        return error <= min(max(nothing_left, MOSTLY * self.missed), CLEARLY * self.missed)

    def _friction(self) -> dict[str, Mapping[str, float]]:
        """Return the friction that explains the oscillation better than a wave from outside does; empty for none."""
        assert self.oscillation is not None  # noqa: S101 - checked by the caller
        thinned, model = self._thinned(), self.expected.model
        otherwise = min(_error(thinned, model), error_beside_wave(thinned, model, self.oscillation.period_s))
        if otherwise < VISIBLE * self.sigma:
            return {}
        friction = likeliest_friction(thinned, model)
        return {friction.name: friction.parameters} if friction.error < EXPLAINED * otherwise else {}

    def _thinned(self) -> Recording:
        """Return the oscillation with no more samples than show its shape."""
        assert self.oscillation is not None  # noqa: S101 - checked by the caller
        every = int(self.oscillation.period_s / (SHAPE * self.steady.sample_interval_s))
        return self.steady.part(slice(None, None, max(every, 1)))

    def _is_another(self, name: str, change: Change) -> bool:
        low, high = self.expected.interval95.get(name, (change.expected, change.expected))
        apart = change.interval95[0] > high or change.interval95[1] < low
        scale = abs(change.expected) or self.recording.sample_interval_s
        if name == "D" and self._own_s is not None:  # a short one matters beside the loop's period, not beside itself
            scale = max(scale, 0.25 * self._own_s)
        return apart and abs(change.found - change.expected) > RELEVANT * scale

    @property
    def _own_s(self) -> float | None:
        """Ultimate period of the process that was expected, s; None where it has none."""
        point = ultimate_point(self.expected.model)
        return None if point is None else point.Pu

    def _sensitivity(self) -> tuple[float | None, float | None] | None:
        if self.found is None or self.expected.gains is None:
            return None
        expected, now = (margins(model, self.expected.gains) for model in (self.expected.model, self.found.model))
        return expected.Ms, now.Ms


def _lost(sensitivity: tuple[float | None, float | None] | None) -> bool:
    then, now = sensitivity or (None, 0.0)
    return then is not None and (now is None or (now > ROBUST_MS and now > MUCH_LESS * then))


def _ms(value: float | None) -> str:
    return "infinite (unstable)" if value is None else f"{value:.2f}"


def _words(name: str, change: Change) -> str:
    low, high = change.interval95
    return f"{name} is {change.found:.3g} ({low:.3g} to {high:.3g}) instead of {change.expected:.3g}"


def _error(recording: Recording, model: ProcessModel) -> float:
    return rms(recording.pv - simulate_fit(model, recording))


def _smooth(pv: FloatArray) -> FloatArray:
    width = max(pv.size // 50, 1)
    kept = pv[: pv.size // width * width].reshape(-1, width)
    return np.asarray(kept.mean(axis=1), dtype=np.float64)


def _moved(recording: Recording, sigma: float) -> bool:
    """Return whether the set point moved far enough for the process to be seen."""
    if recording.set_point is None or not (known := np.isfinite(recording.set_point)).any():
        return False
    return float(np.ptp(recording.set_point[known])) > MOVED * sigma


def _found(recording: Recording, expected: ProcessModel) -> _Found | None:
    """Return the process of this window, of the structure expected; None where it shows none."""
    try:
        identified = identify(recording, expected.structure)
    except AutotunerError:
        return None
    estimate = identified.estimates.get(identified.recommended or "")
    if (
        identified.model is None
        or estimate is None
        or identified.is_a_guess
        or identified.model.structure != expected.structure
    ):
        return None
    now, then = identified.model.parameters(), expected.parameters()
    intervals = estimate.interval95
    if not set(now) <= set(intervals) or not all(math.isfinite(end) for name in now for end in intervals[name]):
        return None
    process = {name: Change(then[name], now[name], intervals[name]) for name in now}
    return _Found(identified.model, process, _error(recording, identified.model))
