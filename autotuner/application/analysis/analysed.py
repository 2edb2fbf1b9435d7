"""The results of a recording, as its worker returns them (`autotuner.application.analysis.procedure`)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.application.analysis.extended_model_selection import are_in_the_gains
from autotuner.core.design import DeviceController, Spans
from autotuner.core.design.simulation.closed_loop_setup import Installed, handy
from autotuner.core.notes import Doubt, Note, notes_among, settled, warnings_among

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.design import PidDesign
    from autotuner.core.design.simulation.actuators import Named
    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.identification import Identification
    from autotuner.core.identification.held_out import HeldOut
    from autotuner.core.recording import Recording
    from autotuner.core.verdict import Verdict


NO_BETTER = 0.95
"""Error on the test part with the effects, over that without them, from which they explain nothing there."""


@dataclass(frozen=True, slots=True)
class Context:
    """Properties of a loop that its recording does not hold.

    Attributes
    ----------
    device : DeviceController or None
        The controller that will hold the gains.
    sample_time_s : float
        Sample time of the loop, s; a controller without a declaration is assumed to run at this scan time.
    output_limits : tuple of float
        Lowest and highest output, output units.
    output_slew_per_s : float
        Fastest change of the output of a controller without a declaration, output units/s.
    """

    device: DeviceController | None = None
    sample_time_s: float = 0.0
    output_limits: tuple[float, float] = (-math.inf, math.inf)
    output_slew_per_s: float = math.inf

    @property
    def output_span(self) -> float:
        """Span of the output, output units; infinite where it is not known."""
        return self.output_limits[1] - self.output_limits[0]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; infinite values are null."""
        return {
            "device": None if self.device is None else {name: _finite(v) for name, v in asdict(self.device).items()},
            "sample_time_s": self.sample_time_s,
            "output_limits": [_finite(edge) for edge in self.output_limits],
            "output_slew_per_s": _finite(self.output_slew_per_s),
        }

    def installed(self, recording: Recording | None, rest: float, effects: Sequence[Named] = ()) -> Installed:
        """Return the loop as predictions take it.

        Parameters
        ----------
        recording : Recording or None
            What was recorded: it shows the size of the steps, half and a quarter of its swing.
        rest : float
            Output at rest, output units.
        effects : sequence of Named
            What a diagnosis found.
        """
        low, high = self.output_limits
        steps = (1.0, 1.0)
        if recording is not None:
            steps = handy(float(np.ptp(recording.pv)) / 2.0), handy(float(np.ptp(recording.output)) / 4.0)
        return Installed(
            (self.device.scan_s if self.device else 0.0) or self.sample_time_s,
            (min(low - rest, 0.0), max(high - rest, 0.0)),
            self.device.slew_per_s if self.device else self.output_slew_per_s,
            rest,
            tuple(effects),
            *steps,
        )


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def context_from(values: Mapping[str, Any] | None) -> Context:
    """Return the context from `Context.to_dict`; `UNKNOWN` for a loop that has not reported any."""
    if not values:
        return Context()
    low, high = values["output_limits"]
    device = None
    if values["device"]:
        given = {name: value for name, value in values["device"].items() if value is not None and name != "spans"}
        device = DeviceController(**given, spans=Spans(**values["device"]["spans"]))
    return Context(
        device,
        values["sample_time_s"],
        (-math.inf if low is None else low, math.inf if high is None else high),
        math.inf if values["output_slew_per_s"] is None else values["output_slew_per_s"],
    )


@dataclass(frozen=True, slots=True)
class Analysis:
    """Results of a recording: the process and its gains.

    Attributes
    ----------
    identification : Identification
        Models with their errors.
    gains : PidDesign or None
        None when no model could be identified, or when there are no such gains for it.
    error : HeldOut or None
        Errors on the fitted and on the other part; None when the check was left out.
    refusal : Verdict or None
        Why the identified process has no gains of the requested kind.
    diagnosis : Diagnosis or None
        What the record shows that a model of the process alone lacks; None where it could not be made.
    sample_time_s : float
        Sample time, s, also assumed for the controller where no other is declared.
    context : Context
        Properties of the loop.
    installed : Installed or None
        Closed loop for the predictions; None without gains.
    gains_hold : bool
        Whether the gains are as robust on the diagnosed process without its disturbances, or on models of separate
        parts of the record.
    is_undisturbed : bool
        Whether the model is that of a part of the record without external disturbances, confirmed on another part.
    """

    identification: Identification
    gains: PidDesign | None
    error: HeldOut | None = None
    refusal: Verdict | None = None
    diagnosis: Diagnosis | None = None
    sample_time_s: float = 0.0
    context: Context = Context()
    installed: Installed | None = None
    gains_hold: bool = False
    is_undisturbed: bool = False

    @property
    def verdict(self) -> Verdict:
        """The refusal, else the identification's verdict."""
        return self.refusal or self.identification.verdict

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings and notes of all parts."""
        unchecked = "the check was left out: dead-band, friction and the like could not be seen"
        missed = self.error.warning if self.error else unchecked
        gains = self.gains.warnings if self.gains else ()
        warnings = (*self.identification.warnings, *((missed,) if missed else ()), *self._lacking(), *gains)
        return settled(warnings) if self.gains_hold else warnings

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings: findings that require action."""
        return tuple(warnings_among(self.messages))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes: findings for information."""
        return tuple(notes_among(self.messages))

    def _lacking(self) -> tuple[str, ...]:
        """Return the missing effects of the diagnosis as a sentence with its advice."""
        diagnosis = self.diagnosis
        if diagnosis is None or diagnosis.verdict == "adequate":
            return ()
        summary = f"diagnosis: {diagnosis.summary}"
        no_action = self._why_no_action(diagnosis)
        if no_action is not None:
            return (Note(summary + no_action),)
        advice = "; ".join(effect.advice for effect in diagnosis.effects if effect.advice)
        advised = f"{summary}: {advice}" if advice else summary
        return (Doubt(advised) if diagnosis.verdict != "explained" or are_in_the_gains(diagnosis) else advised,)

    def _why_no_action(self, diagnosis: Diagnosis) -> str | None:
        """Return why a finding asks for no action, as the end of its sentence; None where it does ask for one."""
        alone, error = diagnosis.disturbances_alone, self.error
        reasons = {
            "": self._explains_nothing(diagnosis) and error is not None and self._leaves_little(error),
            "; the gains are free of it": alone and self.identification.recommended == "diagnosis",
            "; the gains hold for the process without it": alone and (self.gains_hold or self.is_undisturbed),
            "; the model of the gains explains the record without it": alone and self._leaves_noise(error),
        }
        return next((reason for reason, holds in reasons.items() if holds), None)

    @staticmethod
    def _leaves_noise(error: HeldOut | None) -> bool:
        """Return whether the model as it is leaves nothing but noise of the part it was not fitted to."""
        return error is not None and error.noise_sigma > 0.0 and error.warning is None and error.is_small_throughout

    @staticmethod
    def _leaves_little(error: HeldOut) -> bool:
        """Return whether the model as it is misses little: nothing that no effect explains has to be acted on."""
        return error.is_small or error.is_small_throughout

    @staticmethod
    def _explains_nothing(diagnosis: Diagnosis) -> bool:
        """Return whether a diagnosis leaves the test part as it was: there is nothing to act on."""
        held = diagnosis.error["held_out"]
        return not diagnosis.effects or diagnosis.verdict == "unexplained" or held.after > NO_BETTER * held.before

    def to_dict(self) -> dict[str, object]:
        """Return the identification's fields with `error`, `gains` and `tuning`, JSON-ready."""
        return {
            **self.identification.to_dict(),
            "error": self.error.to_dict() if self.error else None,
            "gains": self.gains.gains.to_dict() if self.gains else None,
            "tuning": self.gains.to_dict() if self.gains else None,
            "diagnosis": self.diagnosis.to_dict() if self.diagnosis else None,
            "context": self.context.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }
