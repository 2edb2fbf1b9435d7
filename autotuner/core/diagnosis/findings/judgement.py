"""The verdict: one judgement for a diagnosis and for a tuning.

    expected^2 = noise^2 + what the sensor's own effects leave (a grid of steps, uneven sampling)
               + what moves leave that come late by times that nothing was fitted to

    adequate           no effect; at most 1.5 times what is expected on the fitted part, and 2 on the selection part
    explained          effects; at most 2 times what is expected on both parts; each effect is sure enough, its size is
                       bounded and means what its name says; the gain has the sign that the record proves
    partly_explained   effects that take a good part of the error on the selection part, and fail one of these
    unexplained        anything else

Rules of this file: the verdict follows from the numbers that are reported beside it; the test part is not among them;
what fails is named, so that a reader knows why an effect is a hypothesis only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.findings.result import FoundEffect, Misfit, Outcome

VISIBLE = 1.5
"""Error over what is expected on the fitted part from which a model is not adequate."""
FEW = 2.0
"""Error over what is expected from which a record is not explained."""
LEAST_CONFIDENCE = 0.3
"""Confidence of an effect, together with those that the record cannot tell from it, under which it is a hypothesis."""
MOST_OPEN = 3.0
"""Half width of the 95 % interval of an effect's first size over the size, from which it is a hypothesis."""
GOOD_PART = 0.7
"""Error on the selection part, after over before, up to which it is explained in part."""


def verdict_of(effects: Sequence[FoundEffect], error: Mapping[str, Misfit], doubts: Sequence[str]) -> Outcome:
    """Return the verdict.

    Parameters
    ----------
    effects : sequence of FoundEffect
        What was found.
    error : mapping of str to Misfit
        ``fitted`` and ``selection``.
    doubts : sequence of str
        Why effects are hypotheses only.
    """
    fitted, selection = error["fitted"], error["selection"]
    if effects:
        if fitted.after <= FEW * fitted.expected and selection.after <= FEW * selection.expected and not doubts:
            return "explained"
        helps = selection.after < GOOD_PART * selection.before and fitted.after < GOOD_PART * fitted.before
        return "partly_explained" if helps else "unexplained"
    if not fitted.after < VISIBLE * fitted.expected or selection.after > FEW * selection.expected:
        return "unexplained"
    as_it_was = fitted.before < VISIBLE * fitted.expected and not selection.before > FEW * selection.expected
    return "adequate" if as_it_was else "explained"


def doubts_about(effects: Sequence[FoundEffect]) -> list[str]:
    """Return why effects are hypotheses only, in words."""
    said = []
    for effect in effects:
        together = effect.confidence * (1 + len(effect.indistinguishable))
        if together < LEAST_CONFIDENCE:
            said.append(f"{effect.name} is a hypothesis: its confidence is {effect.confidence:.0%}")
        name, value = next(iter(effect.parameters.items()), ("", math.nan))
        low, high = effect.interval95.get(name, (value, value))
        if not (high - low) / 2.0 <= MOST_OPEN * abs(value):
            said.append(f"{effect.name} is a hypothesis: the record leaves its {name} open ({low:.3g} to {high:.3g})")
    return said
