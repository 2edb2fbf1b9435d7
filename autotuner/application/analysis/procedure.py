"""Analysis of a recording: identification, diagnosis and design. Pure, so a worker process can run it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.application.analysis.analysed import Analysis, Context
from autotuner.application.analysis.basis import basis_of
from autotuner.application.analysis.diagnosis import diagnose
from autotuner.application.analysis.extended_model_selection import (
    gives_a_process,
    halves_the_error,
    with_diagnosed_process,
)
from autotuner.application.analysis.late_load import late_load
from autotuner.application.analysis.learned import learned_models
from autotuner.application.analysis.parts_of_record import (
    CHECK_BEGINS,
    NEVER_FITTED,
    hold_on_parts,
    undisturbed,
)
from autotuner.core.design import DesignSpec, design_from_spec, known_within, margins, with_prediction
from autotuner.core.design.pid_design import judged_process
from autotuner.core.diagnosis.findings.gain_comparison import CALMER, Design
from autotuner.core.estimation.data import TimeSpentError
from autotuner.core.estimation.simulation import simulate_fit
from autotuner.core.identification import identify
from autotuner.core.identification.held_out import SUSPICIOUS, HeldOut, held_out_error, wander_at_rest
from autotuner.core.identification.result import UNEXPLAINED, most_unexplained, share_unexplained, what_looks_so
from autotuner.core.model.process import model_from_dict
from autotuner.core.notes import Doubt, Note
from autotuner.core.verdict import refused
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design import DeviceController, Installed, PidDesign, PidGains
    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.diagnosis.findings.gain_comparison import Choose
    from autotuner.core.identification import Identification
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.verdict import Verdict

WORSE_THAN_NOTHING = 1.0
"""Share of the motion that a model may leave unexplained on the part that it was not fitted to: there it may miss a
disturbance, but not all of it. On its own record the limit is `most_unexplained`."""
UNEXPLAINED_RECORD = "record_unexplained"
BALANCED = DesignSpec()
UNKNOWN = Context()
NOTHING_BUT_NOISE = 1.1
"""Misfit over white noise up to which a model of relay and check is taken although that of the relay part missed it;
what coloured noise is at rest is known less well, there it is `SUSPICIOUS`."""
AS_ROBUST = 1.1
"""Largest ratio of Ms on the diagnosed process to Ms on the identified one at which gains hold for both."""
NO_DIAGNOSIS = "the time did not suffice for a diagnosis: `autotuner diagnose` makes one of the recording"
OUTLIERS = 0.05
"""Share of the samples that does not count in either."""


def analyse(
    recording: Recording,
    structure: str = "auto",
    spec: DesignSpec = BALANCED,
    context: Context = UNKNOWN,
    is_spent: Callable[[], bool] | None = None,
) -> Analysis:
    """Identify the process of a tuning's record, design gains, and diagnose the record.

    The gains are designed and predicted for the controller that will hold them.

    Parameters
    ----------
    recording, structure, spec, context, is_spent
        As in `identified`; no diagnosis begins when the time is spent.
    """
    analysis = identified(recording, structure, spec, context, is_spent)
    if analysis.identification.model is None:
        return analysis
    if is_spent is not None and is_spent():
        annotated = replace(analysis.identification, warnings=(*analysis.identification.warnings, Note(NO_DIAGNOSIS)))
        return predicted(replace(analysis, identification=annotated), recording)
    requested = _design_for(analysis, spec)
    try:
        diagnosis = diagnose(recording, requested=requested)
    except InputError:
        return predicted(analysis, recording)
    return predicted(_reconsidered(replace(analysis, diagnosis=diagnosis), recording, spec), recording)


def predicted(analysis: Analysis, recording: Recording) -> Analysis:
    """Return the analysis with the responses under its gains, with the effects of the diagnosis in the loop."""
    effects = analysis.diagnosis.effects if analysis.diagnosis else ()
    rest = recording.settings.get("initial_output")
    rest = rest if isinstance(rest, float) else float(recording.output[0])
    installed = analysis.context.installed(recording, rest, effects)
    if analysis.gains is None:
        return replace(analysis, installed=installed)
    context = analysis.context
    hold = _hold(analysis.gains, analysis.diagnosis, analysis.sample_time_s)
    if not hold and any(isinstance(message, Doubt) for message in analysis.messages):
        hold = _hold_on_parts(analysis, analysis.gains.gains, recording)
    basis = basis_of(
        analysis.identification, analysis.sample_time_s, device=context.device, output_span=context.output_span
    )
    gains = with_prediction(analysis.gains, basis, installed)
    return replace(analysis, installed=installed, gains=gains, gains_hold=hold)


def _hold_on_parts(analysis: Analysis, gains: PidGains, recording: Recording) -> bool:
    try:
        return hold_on_parts(recording, analysis.identification, gains, analysis.sample_time_s)
    except InputError:
        return False


def _hold(chosen: PidDesign, diagnosis: Diagnosis | None, sample_time_s: float) -> bool:
    """Return whether gains are about as robust on the diagnosed process as on the identified one."""
    model_after = diagnosis.model.get("after") if diagnosis is not None and diagnosis.verdict == "explained" else None
    if chosen.margins is None or chosen.margins.Ms is None or not isinstance(model_after, dict):
        return False
    names = {name: value for name, value in model_after.items() if isinstance(value, str | float)}
    judged = judged_process(model_from_dict(names), sample_time_s)[0]
    found = margins(judged, chosen.gains) if judged is not None else None
    return found is not None and found.Ms is not None and found.Ms <= AS_ROBUST * chosen.margins.Ms


def _design_for(analysis: Analysis, spec: DesignSpec) -> Design:
    """Return the design of the tuning's gains, so that those of the diagnosis are comparable."""
    identification, context = analysis.identification, analysis.context
    basis = basis_of(identification, analysis.sample_time_s, device=context.device, output_span=context.output_span)

    def chosen_for(spec: DesignSpec) -> Choose:
        def choose(model: ProcessModel, covariance: FloatArray | None) -> PidGains:
            covariance, known_as = known_within(model, covariance, None)
            return design_from_spec(
                replace(basis, model=model, covariance=covariance, known_as=known_as), spec, compared=False
            ).gains

        return choose

    by_goal_alone = spec == DesignSpec(spec.goal) and spec.goal != CALMER
    calmer = Design(CALMER, chosen_for(replace(spec, goal=CALMER))) if by_goal_alone else None
    return Design(spec.name, chosen_for(spec), calmer, analysis.gains.gains if analysis.gains else None)


def _reconsidered(analysis: Analysis, recording: Recording, spec: DesignSpec) -> Analysis:
    """Return the analysis with the diagnosed process where the model without its effects explained too little.

    A model can fit its own part of the record by absorbing a missing effect, and be far off: with backlash, a lag of
    10 s is identified as 30 s. A visible misfit of the remaining record is therefore sufficient reason; without a
    check, the held-out part of the diagnosis is used.
    """
    refusal, diagnosis = analysis.refusal, analysis.diagnosis
    unexplained = refusal is not None and refusal.code == UNEXPLAINED_RECORD
    missed = refusal is None and _misses(analysis.error, diagnosis)
    if diagnosis is None or not (unexplained or missed):
        return analysis
    if not gives_a_process(diagnosis, recording, UNEXPLAINED) or (missed and not halves_the_error(diagnosis)):
        return analysis
    identification = with_diagnosed_process(analysis.identification, diagnosis)
    if identification.model is None or _wrong_way(identification.model, recording):
        return analysis
    error = analysis.error and HeldOut(
        diagnosis.error["fitted"].after, diagnosis.error["held_out"].after, diagnosis.error["held_out"].noise
    )
    chosen = _with_gains(identification, error, spec, None, recording.sample_interval_s, analysis.context)
    return replace(chosen, diagnosis=_with_own_gains(diagnosis, chosen.gains))


def _with_own_gains(diagnosis: Diagnosis, chosen: PidDesign | None) -> Diagnosis:
    """Return a diagnosis whose gains `after` are those of the tuning: both are of one process and one design.

    The diagnosis designed its own gains before the noise, which limits the output's movement, was known.
    """
    after = diagnosis.gains.get("after")
    if chosen is None or chosen.margins is None or not isinstance(after, dict):
        return diagnosis
    tuned = {"gains": chosen.gains.to_dict(), "margins": chosen.margins.to_dict()}
    return replace(diagnosis, gains={**diagnosis.gains, "after": {**after, **tuned}})


def _misses(error: HeldOut | None, diagnosis: Diagnosis | None) -> bool:
    """Return whether the model visibly misses the check, or without a check the held-out part of the diagnosis."""
    if error is not None or diagnosis is None:
        return error is not None and error.warning is not None
    held = diagnosis.error["held_out"]
    return HeldOut(0.0, held.before, held.noise).warning is not None


def identified(
    recording: Recording,
    structure: str = "auto",
    spec: DesignSpec = BALANCED,
    context: Context = UNKNOWN,
    is_spent: Callable[[], bool] | None = None,
) -> Analysis:
    """Identify the process of a tuning's record, validate the model on held-out parts, and design gains.

    A model of the relay part alone is judged on the whole check. When it misses no more than noise there, the process
    is what the model predicts, and the check up to the tail is fitted too: its slow moves show the static gain far
    better than the relay does. The tail then remains to judge by. When it misses more, and yet one model leaves nothing
    but noise of both and of the tail, nothing is missing: a relay part that began in the last of an earlier motion of
    the PV, hardly visible in the noise, can take it for a gain that is 7 % less, with an interval that does not know.

    Parameters
    ----------
    recording : Recording
        Samples of the experiment; its settings name the parts.
    structure : str
        Process structure, or ``auto``.
    spec : DesignSpec
        The requested design.
    context : Context
        Properties of the loop, such as the controller that will hold the gains.
    is_spent : callable, optional
        Returns whether the time is spent; the model of the relay part alone is kept where that is in time.

    Raises
    ------
    TimeSpentError
        The time did not suffice for the relay part.
    """
    segments = recording.segments
    if CHECK_BEGINS not in segments:
        identification = identify(recording, structure=structure, learned=learned_models(), is_spent=is_spent)
        distrust = distrusted(recording, identification, math.inf)
        return _with_gains(identification, None, spec, distrust, recording.sample_interval_s, context)
    until_s = segments[CHECK_BEGINS]
    identification, error = _judged(recording, structure, until_s, is_spent)
    if error is not None and NEVER_FITTED in segments:
        missed = error.warning is not None
        wanted = structure if missed else identification.structure or structure
        try:
            whole, whole_error = _judged(recording, wanted, segments[NEVER_FITTED], is_spent)
        except TimeSpentError:
            whole_error = None
        if whole_error is not None and not (missed and _lacks_something(whole, whole_error)):
            identification, error = _joined(identification, whole), whole_error
            until_s = segments[NEVER_FITTED]
    distrust = distrusted(recording, identification, until_s)
    analysis = _with_gains(identification, error, spec, distrust, recording.sample_interval_s, context)
    if analysis.gains is None or isinstance(error and error.warning, Doubt):
        if (excused := _before_a_load(analysis, recording, until_s)) is not None:
            return excused
        part = _undisturbed(recording, structure, identification, is_spent)
        instead = part and _with_gains(*part, spec, None, recording.sample_interval_s, context)
        return analysis if instead is None or instead.gains is None else replace(instead, is_undisturbed=True)
    return analysis


def _before_a_load(analysis: Analysis, recording: Recording, until_s: float) -> Analysis | None:
    """Return the analysis with a load on the part not fitted, which explains all that the model misses there."""
    identification, error = analysis.identification, analysis.error
    if analysis.gains is None or identification.model is None or error is None:
        return None
    load = late_load(identification.model, recording, until_s, error.noise_sigma)
    if load is None:
        return None
    noted = replace(identification, warnings=(Note(load.words), *identification.warnings))
    return replace(analysis, identification=noted, error=load.error, is_undisturbed=True)


def _undisturbed(
    recording: Recording, structure: str, whole: Identification, is_spent: Callable[[], bool] | None
) -> tuple[Identification, HeldOut] | None:
    """Return the model of an undisturbed part of the record; None where there is none, or the time limit has passed."""
    try:
        part = undisturbed(recording, structure, whole, is_spent)
    except TimeSpentError:
        return None
    return None if part is None or part[0].model is None or _wrong_way(part[0].model, recording) else part


def distrusted(recording: Recording, identification: Identification, until_s: float) -> Verdict | None:
    """Return a refusal for a model that does not explain its record: gains for it would be wrong without a sign.

    Judged by `share_unexplained` of all but the largest `OUTLIERS` of the residuals; fitted was the part to `until_s`.
    """
    model, sigma = identification.model, identification.fit.noise_sigma
    if model is None:
        return None
    if _wrong_way(model, recording):
        return refused(
            UNEXPLAINED_RECORD,
            f"the best model ({identification.structure}) has a static gain of {model.K:.4g}, but the PV was seen to "
            "follow the output the other way: gains for it would drive the loop away",
            "Inspect the recording: something else moved the PV, or its gain depends on the direction. Run the test "
            "with the check, or with a symmetric relay (ratio 1).",
        )
    left = recording.pv - simulate_fit(model, recording, until_s)
    fitted = recording.t <= until_s
    parts = [("of its own record", most_unexplained(model), left[fitted], recording.pv[fitted])]
    if not fitted.all():
        parts.append(("on the part that was not fitted", WORSE_THAN_NOTHING, left[~fitted], recording.pv))
    for where, most, residual, motion in parts:
        rms = _without_outliers(residual)
        share = share_unexplained(rms, sigma, motion)
        if share > most:
            return refused(
                UNEXPLAINED_RECORD,
                f"the best model ({identification.structure}) leaves {share:.0%} of the motion unexplained {where}: "
                f"{rms / sigma if sigma > 0.0 else math.inf:.3g} times the noise: gains for it would be a guess",
                "Inspect the recording: something else moved the PV (a load, another loop, a sensor or a line with "
                "gaps). Repeat the test when that is quiet; keep the recording for a diagnosis"
                f"{what_looks_so(model)}.",
            )
    return None


def _wrong_way(model: ProcessModel, recording: Recording) -> bool:
    """Return whether a model's gain is against the action that the experiment was run, and the PV answered, with."""
    direct = recording.settings.get("direct")
    return direct is not None and (model.K > 0.0) != bool(direct)


def _without_outliers(residual: FloatArray) -> float:
    """Return the root mean square without the largest `OUTLIERS`: one damaged digit is no motion of the process."""
    squares = np.sort(residual**2)
    return math.sqrt(float(squares[: max(math.ceil((1.0 - OUTLIERS) * squares.size), 1)].mean()))


def _judged(
    recording: Recording, structure: str, until_s: float, is_spent: Callable[[], bool] | None = None
) -> tuple[Identification, HeldOut | None]:
    """Identify on the samples up to a time, and judge the model on those after it."""
    fitted = recording.window(float(recording.t[0]), until_s)
    identification = identify(fitted, structure=structure, learned=learned_models(), is_spent=is_spent)
    if identification.model is None:
        return identification, None
    sigma = max(identification.fit.noise_sigma, wander_at_rest(recording))
    return identification, held_out_error(identification.model, recording, until_s, sigma)


def _lacks_something(whole: Identification, error: HeldOut) -> bool:
    """Return whether a model of relay and check leaves more than noise there, or on the tail."""
    is_coloured = error.noise_sigma > whole.fit.noise_sigma
    most = SUSPICIOUS if is_coloured else NOTHING_BUT_NOISE
    return error.warning is not None or whole.fit.rmse > most * error.noise_sigma


def _joined(relay: Identification, whole: Identification) -> Identification:
    """Return the model of the full record, with the limit cycle and its estimates, which only the relay part has."""
    from_cycle = {name: estimate for name, estimate in relay.estimates.items() if name != whole.recommended}
    estimates = {**whole.estimates, **from_cycle}
    return replace(whole, limit_cycle=relay.limit_cycle, points=relay.points, estimates=estimates)


def _with_gains(
    identification: Identification,
    error: HeldOut | None,
    spec: DesignSpec,
    distrust: Verdict | None,
    sample_time_s: float,
    context: Context,
) -> Analysis:
    """Choose gains; a test that was run is not lost to a rule that does not fit the process."""
    if identification.model is None or distrust is not None:
        return Analysis(identification, None, error, distrust, sample_time_s=sample_time_s, context=context)
    try:
        chosen = gains_for(identification, spec, sample_time_s, device=context.device, output_span=context.output_span)
        return Analysis(identification, chosen, error, sample_time_s=sample_time_s, context=context)
    except InputError as unfit:
        refusal = refused("no_gains", unfit.finding, unfit.remedy)
        return Analysis(identification, None, error, refusal, sample_time_s=sample_time_s, context=context)


def gains_for(
    identification: Identification,
    spec: DesignSpec = BALANCED,
    sample_time_s: float = 0.0,
    *,
    interval_s: float = 0.0,
    device: DeviceController | None = None,
    installed: Installed | None = None,
    output_span: float = math.inf,
) -> PidDesign:
    """Return gains for an identified process: the same whether they are requested with a tuning or after it.

    They keep their limits over the 95 % region of the model, where the identification states its errors.

    Parameters
    ----------
    identification : Identification
        One with a model.
    spec : DesignSpec
        The request.
    sample_time_s : float
        Sample time of the controller, s; 0: not known.
    interval_s : float
        Time between two samples of the recording, s, where that is not the controller's.
    device : DeviceController, optional
        The controller that will hold the gains.
    installed : Installed, optional
        The loop, for the prediction of its responses; without it nothing is predicted.
    output_span : float
        Span of the output, output units, for the limit of its movement; infinite where it is not known.
    """
    basis = basis_of(identification, sample_time_s, interval_s=interval_s, device=device, output_span=output_span)
    chosen = design_from_spec(basis, spec)
    return chosen if installed is None else with_prediction(chosen, basis, installed)
