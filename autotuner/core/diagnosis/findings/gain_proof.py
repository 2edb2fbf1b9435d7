"""Whether a record proves a process for which gains may be designed.

Gains are refused where

1. the process alone is the inverse of the controller;
2. a gain of the other sign explains the record about as well, alone or beside effects, or the sign changes with them;
3. the record is not explained, and the model leaves more of the PV's motion than a tuning allows;
4. the record is not explained, and `identify` refuses it.

The records of a tuning are judged by the tuning itself, by the same figures.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical, is_the_controller
from autotuner.core.identification.procedure import identify
from autotuner.core.identification.result import most_unexplained

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.findings.result import Misfit, Outcome
    from autotuner.core.diagnosis.search.trace import Trace
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

AS_GOOD = 1.1
"""Error with a gain of the other sign, over that of the best, up to which the record does not prove the sign."""


def doubts_about_sign(context: FitContext, found: Trace) -> list[str]:
    """Return why the record does not prove the sign of the gain beside effects; empty where no other sign comes near.

    The dead time may attribute a response to the move before, which went the other way.
    """
    chosen = found.chosen
    gain, later = float(chosen.linear[0]), AS_GOOD * context.held_out_error(chosen)
    near = (
        other
        for other in (found.pool if chosen.problem.effects else ())
        if float(other.linear[0]) * gain < 0.0
        and other.rms < AS_GOOD * chosen.rms
        and context.held_out_error(other) < later
        and is_physical(other)
    )
    opposite = min(near, key=context.on_both_parts, default=None)
    if opposite is None:
        return []
    names = " and ".join(dict.fromkeys(opposite.reported_names())) or "nothing"
    return [f"a process of the opposite gain, with {names} beside it, explains the record about as well"]


def why_no_gains(
    recording: Recording, first: Base, found: Trace, verdict: Outcome, fitted: Misfit, sign: Sequence[str]
) -> str | None:
    """Return why no gains may be designed; None where they may.

    Parameters
    ----------
    recording : Recording
        The record up to its test part.
    first : Base
        The process alone.
    found : Trace
        What the search found.
    verdict : str
        The verdict.
    fitted : Misfit
        The errors on the fitted part.
    sign : sequence of str
        Doubts about the sign of the gain.
    """
    if sign:
        return sign[0]
    if verdict == "explained":
        return None
    plain = first.best.process()
    if is_the_controller(first.best):
        return "the model without the effects is the inverse of the controller, and not the process"
    if first.other_sign_rms < AS_GOOD * first.best.rms:
        return "a process of the opposite gain explains the record about as well"
    if found.chosen.process().K * plain.K < 0.0:
        return "the sign of the gain depends on what is assumed beside the process"
    return None if verdict == "adequate" else _why_no_plain_gains(recording, plain, fitted)


def _why_no_plain_gains(recording: Recording, plain: ProcessModel, fitted: Misfit) -> str | None:
    """Return why the model without effects is no basis for gains where an effect is missing; None where it is one."""
    moved = float(np.std(recording.pv))
    share = math.sqrt(max(fitted.before**2 - fitted.expected**2, 0.0)) / moved if moved > 0.0 else 1.0
    if share > most_unexplained(plain):
        return f"the model leaves {share:.0%} of the PV's motion unexplained"
    answer = identify(recording, profile=False)
    if answer.model is None:
        return answer.verdict.message
    agrees = answer.model.K * plain.K > 0.0
    return None if agrees else "the sign of the gain depends on how the process is fitted"
