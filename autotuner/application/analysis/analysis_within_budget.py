"""Analysis of a tuning's record within a budget of processor time: the learned correction first, then least squares.

    learned correction -> least squares, search for gains, diagnosis   while there is time
                       -> a rule at the cautious end of its errors     otherwise

The learned model must pass the same validation as every model: with a large unexplained share it has no gains. Its
gains are those of a running tuning (`early_gains`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.application.analysis.analysed import Analysis
from autotuner.application.analysis.early_gains import early_rule, running_of
from autotuner.application.analysis.learned import learned_models
from autotuner.application.analysis.parts_of_record import CHECK_BEGINS, NEVER_FITTED
from autotuner.application.analysis.procedure import analyse, distrusted, predicted
from autotuner.control.clock.ticker import processor_time_spent
from autotuner.core.design import PidDesign, margins
from autotuner.core.design.pid_design import judged_process
from autotuner.core.estimation.data import TimeSpentError
from autotuner.core.identification.held_out import held_out_error
from autotuner.core.identification.within_budget import MORE_TIME, learned_alone, learned_estimate
from autotuner.core.notes import Note
from autotuner.core.verdict import refused

if TYPE_CHECKING:
    from autotuner.application.analysis.analysed import Context
    from autotuner.core.design import DesignSpec
    from autotuner.core.identification import Identification
    from autotuner.core.identification.result import Estimate
    from autotuner.core.recording import Recording

SPENT = "the time did not suffice for least squares"
TOO_OPEN = "its errors are too large for gains"


def analyse_within(
    recording: Recording, structure: str, spec: DesignSpec, context: Context, budget_ms: float
) -> Analysis:
    """Analyse a tuning's record within a budget of processor time.

    Parameters
    ----------
    recording, structure, spec, context
        As in `procedure.identified`.
    budget_ms : float
        Processor time of this process, ms. The learned correction has its time whatever it is.
    """
    models = learned_models()  # loaded once in each process, outside of the budget
    is_spent = processor_time_spent(budget_ms)
    start_s, segments = float(recording.t[0]), recording.segments
    until_s = segments.get(CHECK_BEGINS, math.inf)
    relay = recording.window(start_s, until_s)
    window = recording.window(start_s, segments.get(NEVER_FITTED, math.inf))
    quick = learned_estimate(relay, window, structure, learned=models)
    try:
        return analyse(recording, structure, spec, context, is_spent)
    except TimeSpentError:
        return _early(recording, relay, quick, spec, context)


def _early(recording: Recording, relay: Recording, quick: Estimate, spec: DesignSpec, context: Context) -> Analysis:
    """Return the learned model with its gains, or with the reason for their absence."""
    identification, every_s = learned_alone(relay, quick), recording.sample_interval_s
    if identification.model is None:
        return Analysis(identification, None, sample_time_s=every_s, context=context)
    segments = recording.segments
    judged_from = segments.get(NEVER_FITTED, segments.get(CHECK_BEGINS))
    error = None
    if judged_from is not None:
        error = held_out_error(identification.model, recording, judged_from, identification.fit.noise_sigma)
    distrust = distrusted(recording, identification, math.inf if judged_from is None else judged_from)
    chosen = None if distrust is not None else _design(identification, spec, every_s, context)
    refusal = None
    if chosen is None:
        reason = TOO_OPEN if distrust is None else distrust.message
        refusal = refused("budget_spent", f"{SPENT}, and the learned model has no gains: {reason}", MORE_TIME)
    analysis = Analysis(identification, chosen, error, refusal, sample_time_s=every_s, context=context)
    return predicted(analysis, recording)


def _design(
    identification: Identification, spec: DesignSpec, sample_time_s: float, context: Context
) -> PidDesign | None:
    """Return the gains of the rule as a design, with margins on the learned model; None where the model is unusable."""
    found = early_rule(running_of(identification), sample_time_s)
    judged = judged_process(identification.model, context.sample_time_s or sample_time_s)[0]
    if found is None or judged is None:
        return None
    gains = found.gains if context.device is None else context.device.as_run(found.gains)
    note = Note(
        f"early gains: {found.rule} at the cautious end of the model's errors instead of {spec.name}, whose search "
        "takes more time"
    )
    return PidDesign(None, found.rule, gains, margins(judged, gains), (), (note, *found.warnings))
