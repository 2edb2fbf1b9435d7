"""A diagnosis within a time limit: `core` reads no clock, so the limit is made here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import processor_time_spent, time_spent
from autotuner.core.diagnosis.findings.gain_comparison import NOMINAL
from autotuner.core.diagnosis.procedure import diagnose as search
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.diagnosis.findings.gain_comparison import Design
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

USUAL_LIMIT_MS = 60_000.0
"""Processor time of a search without a limit, ms. The longest known takes 37 s, two effects in a loop. The same search
takes up to twice its processor time beside other programs, and its verdict should not depend on these."""


def diagnose(
    recording: Recording,
    model: ProcessModel | None = None,
    *,
    requested: Design = NOMINAL,
    time_limit_s: float | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Return the effects that a recording shows and a model lacks: their sizes, evidence, and influence on the gains.

    Parameters
    ----------
    recording : Recording
        Output and PV: a tuning's own record, a step test, a historian's CSV.
    model : ProcessModel, optional
        The declared model; without it the process is identified from the same record.
    requested : Design
        Design of the gains before and after; by default those of the goal ``balanced``.
    time_limit_s : float, optional
        Time limit of the search, s; by default 60 s of processor time. After it, the verdict is ``unexplained`` with
        the best effects so far. The process alone and the report, one or two seconds, are computed in any case.
    on_progress : callable, optional
        Called with a sentence on the progress of the search.

    Raises
    ------
    RecordingError
        The record cannot show a process; the error has the reason and a remedy.
    InputError
        The limit is not positive.
    """
    if time_limit_s is not None and not time_limit_s > 0.0:
        raise InputError("is no time", field="time_limit_s", value=time_limit_s, remedy="Give seconds, or no limit.")
    is_spent = processor_time_spent(USUAL_LIMIT_MS) if time_limit_s is None else time_spent(time_limit_s)
    return search(recording, model, requested=requested, is_spent=is_spent, on_progress=on_progress)
