"""From a recording to gains: the pure part of a tuning, made to be sent to a worker process."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.held_out import HeldOut, held_out_error
from autotuner.core.identification import identify
from autotuner.core.tuning import tune
from autotuner.core.verdict import refused
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict

CHECK_BEGINS = "half_relay"
"""The first part of the record that the model of the relay part is judged on."""
NEVER_FITTED = "tail"
"""The part of the record that no model is fitted to."""
UNEXPLAINED = 0.25
"""Share of the PV's motion, beyond noise, that a model may leave unexplained on its own record to be worth gains."""
WORSE_THAN_NOTHING = 1.0
"""The same on the part that it was not fitted to: there a model may miss a disturbance, but not all of the motion."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """What a recording told, and the gains that follow.

    Attributes
    ----------
    identification : Identification
        Models with their errors.
    gains : Gains or None
        None when no model could be identified, or when there are no such gains for it.
    error : HeldOut or None
        Errors on the fitted and on the other part; None when the check was left out.
    refusal : Verdict or None
        Why the identified process has no gains of the kind that was asked.
    """

    identification: Identification
    gains: Gains | None
    error: HeldOut | None = None
    refusal: Verdict | None = None

    @property
    def verdict(self) -> Verdict:
        """The refusal, else the identification's verdict."""
        return self.refusal or self.identification.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of all parts."""
        unchecked = "the check was left out: dead-band, friction and the like could not be seen"
        missed = self.error.warning if self.error else unchecked
        gains = self.gains.warnings if self.gains else ()
        return (*self.identification.warnings, *((missed,) if missed else ()), *gains)

    def to_dict(self) -> dict[str, object]:
        """Return the identification's fields with `error`, `gains` and `tuning` beside them, JSON-ready."""
        return {
            **self.identification.to_dict(),
            "error": self.error.to_dict() if self.error else None,
            "gains": self.gains.gains.to_dict() if self.gains else None,
            "tuning": self.gains.to_dict() if self.gains else None,
            "warnings": list(self.warnings),
        }


def analyse(recording: Recording, structure: str = "auto", goal: str = "balanced", rule: str | None = None) -> Analysis:
    """Identify the process behind a tuning's record, judge the model on what it was not fitted to, and choose gains.

    A model of the relay part alone is judged on the whole check. When it misses no more than noise there, the process
    is what the model says, and the check up to the tail is fitted too: its slow moves tell the static gain far better
    than the relay does. The tail then remains to judge by.

    Parameters
    ----------
    recording : Recording
        Samples of the experiment; its settings name the parts.
    structure : str
        Process structure, or ``auto``.
    goal : str
        Goal of the gains.
    rule : str, optional
        A tuning rule by name instead of the goal.
    """
    segments = _segments(recording)
    if CHECK_BEGINS not in segments:
        identification = identify(recording, structure=structure)
        return _with_gains(identification, None, goal, rule, _distrust(identification, None, recording))
    identification, error = _judged(recording, structure, segments[CHECK_BEGINS])
    if error is not None and error.warning is None and NEVER_FITTED in segments:
        whole, whole_error = _judged(recording, identification.structure or structure, segments[NEVER_FITTED])
        if whole_error is not None:
            identification, error = _joined(identification, whole), whole_error
    return _with_gains(identification, error, goal, rule, _distrust(identification, error, recording))


def _distrust(identification: Identification, error: HeldOut | None, recording: Recording) -> Verdict | None:
    """Return a refusal for a model that does not explain its record: gains for it would be wrong without a sign.

        share = sqrt(max(rms^2 - sigma^2, 0))/std(pv)

    `rms` of the residual, `sigma` of the noise, `std(pv)` of the whole record.
    """
    if identification.model is None:
        return None
    sigma, moved = identification.fit.noise_sigma, float(np.std(recording.pv))
    residuals = {UNEXPLAINED: identification.fit.rmse, WORSE_THAN_NOTHING: error.held_out if error else 0.0}
    shares = {most: math.sqrt(max(rms * rms - sigma * sigma, 0.0)) / moved for most, rms in residuals.items()}
    most, share = max(shares.items(), key=lambda item: item[1] / item[0])
    if share <= most:
        return None
    where = "on the part of the record that was not fitted" if most == WORSE_THAN_NOTHING else "of its own record"
    return refused(
        "record_unexplained",
        f"the best model ({identification.structure}) leaves {share:.0%} of the PV's motion unexplained {where}, "
        f"{residuals[most] / sigma if sigma > 0.0 else math.inf:.3g} times the noise: gains for it would be a guess",
        "Look at the recording: something else moved the PV (a load, another loop, a sensor or a line with gaps). "
        "Repeat the test when that is quiet; keep the recording for a diagnosis.",
    )


def _judged(recording: Recording, structure: str, until_s: float) -> tuple[Identification, HeldOut | None]:
    """Identify on the samples up to a time, and judge the model on those after it."""
    identification = identify(recording.window(float(recording.t[0]), until_s), structure=structure)
    if identification.model is None:
        return identification, None
    return identification, held_out_error(identification.model, recording, until_s, identification.fit.noise_sigma)


def _joined(relay: Identification, whole: Identification) -> Identification:
    """Return what the longer record told, with the limit cycle and its estimates, which only the relay part holds."""
    from_cycle = {name: estimate for name, estimate in relay.estimates.items() if name != whole.recommended}
    estimates = {**whole.estimates, **from_cycle}
    return replace(whole, limit_cycle=relay.limit_cycle, points=relay.points, estimates=estimates)


def _with_gains(
    identification: Identification, error: HeldOut | None, goal: str, rule: str | None, distrust: Verdict | None
) -> Analysis:
    """Choose gains; a test that was run is not lost to a rule that does not fit the process."""
    if identification.model is None or distrust is not None:
        return Analysis(identification, None, error, distrust)
    try:
        return Analysis(identification, gains_for(identification, goal, rule), error)
    except InputError as unfit:
        return Analysis(identification, None, error, refused("no_gains", str(unfit), unfit.remedy))


def gains_for(
    identification: Identification, goal: str = "balanced", rule: str | None = None, tau_c_s: float | None = None
) -> Gains:
    """Return gains for an identified process: the same whether they are asked for with a tuning or after it.

    Parameters
    ----------
    identification : Identification
        One with a model.
    goal, rule, tau_c_s
        As in `autotuner.core.tuning.tune`.
    """
    return tune(identification.model, goal=goal, rule=rule, tau_c_s=tau_c_s)


def _segments(recording: Recording) -> Mapping[str, float]:
    segments = recording.settings.get("segments")
    return segments if isinstance(segments, dict) else {}
