"""The verdict: one judgement for a diagnosis and for a tuning.

    expected^2 = noise^2 + error by the sensor's own effects (quantisation, uneven sampling)
               + error by what the record leaves open (see `left_open_later`)

    adequate           no effect; at most 1.5 times the expected error on the fitted part, and 2 on the selection part,
                       or 3 for autoregressive noise, whose innovations were judged (see `coloured_noise`); or as much
                       as the errors of the process's numbers make there
    explained          effects; at most 2 times the expected error on both parts; no reason against them in `doubts`
    partly_explained   effects that fail one of these, and explain a good part of the error on the selection part, and
                       of that on the fitted part where they leave more than 2 times the expected one there
    unexplained        anything else

Invariants: the verdict follows from the reported numbers, and from how well the record knows those of the process;
the test part has no say in it;
each failed condition is named, so that a reader knows why an effect is only a hypothesis.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.findings.result import FoundEffect, Misfit, Outcome

VISIBLE = 1.5
"""Ratio of the error to the expected one on the fitted part from which a model is not adequate."""
FEW = 2.0
"""Ratio of the error to the expected one from which a record is not explained."""
WITH_MEMORY = 3.0
"""The same for autoregressive noise: a short part contains only a few of its swings."""
GOOD_PART = 0.7
"""Error on the selection part, after over before, up to which it is explained in part."""


def verdict_of(
    effects: Sequence[FoundEffect],
    error: Mapping[str, Misfit],
    doubts: Sequence[str],
    *,
    has_memory: bool = False,
    foreseen: bool = False,
) -> Outcome:
    """Return the verdict.

    Parameters
    ----------
    effects : sequence of FoundEffect
        What was found.
    error : mapping of str to Misfit
        ``fitted`` and ``selection``.
    doubts : sequence of str
        Why effects are hypotheses only.
    has_memory : bool
        Whether the residual is noise with a memory, and no more than that.
    foreseen : bool
        Whether the errors of the numbers make the error on the selection part.
    """
    most = math.inf if foreseen else WITH_MEMORY if has_memory else FEW
    fitted, selection = error["fitted"], error["selection"]
    if effects:
        if is_close(fitted) and is_close(selection) and not doubts:
            return "explained"
        helps = selection.after < GOOD_PART * selection.before
        helps_there = is_close(fitted) or fitted.after < GOOD_PART * fitted.before
        return "partly_explained" if helps and helps_there else "unexplained"
    if not fitted.after < VISIBLE * fitted.expected or selection.after > most * selection.expected:
        return "unexplained"
    as_it_was = fitted.before < VISIBLE * fitted.expected and not selection.before > most * selection.expected
    return "adequate" if as_it_was else "explained"


def is_close(part: Misfit) -> bool:
    """Return whether an explanation leaves little more than the expected error on a part of the record."""
    return part.after <= FEW * part.expected
