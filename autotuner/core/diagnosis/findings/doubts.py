"""Reasons why effects are only hypotheses, whatever error they leave.

    confidence   above 55 %: clearly likelier than all other explanations together; of the effect with all others at its
                 place, for the process without them is the same, but at least 40 % alone. In a closed loop, where
                 every oscillation may be cause or response, of the effect alone
    bounded      half width of the 95 % interval, at most half of the value: one size of every effect; the gain of the
                 process and its response time T + D (for an underdamped one, the damping n of m s^2 + n s + 1)
    sign         in a closed loop, the gain has the same sign without the effects; and anywhere, no explanation with one
                 of the other sign comes as near (see `gain_proof`)
    selection    its later half is fitted as well as the whole; the effects do not increase the error on it
    readings     a sensor that repeats its readings has sent enough new ones
    course       a load of free shape is not alone: it predicts nothing of what follows
    answer       no load begins or ends, and no drift begins, where one of a few moves of the output arrives at the PV

Invariants: all reasons follow from fit and selection part; each one is a sentence for the reader.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.findings.judgement import FEW, VISIBLE
from autotuner.core.diagnosis.record.sensor import FEWEST_NEW, new_readings
from autotuner.core.diagnosis.search.acceptance import is_free_load
from autotuner.core.diagnosis.search.coincidence import BEGINS, DRIFT, LOAD, answers_a_move
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.quantiles import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.findings.result import FoundEffect, Misfit
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.diagnosis.record.sensor import Grid
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

LIKELIER = 0.55
"""Confidence up to which the other explanations together are as likely: one half, for one equally good alternative,
plus the contribution of unlikely ones."""
ONE_OTHER = 0.4
"""The same for the effect alone, whatever else acts at its place: two equally likely other names make it a guess."""
MOST_OPEN = 0.5
"""Half width of a 95 % interval over the value, from which the value is not determined by the record."""
TIMES = ("T", "T1", "T2", "T3", "D")
"""Parameters whose sum is the response time of a process without oscillation."""
DAMPING = "n"


def doubts_about(effects: Sequence[FoundEffect], *, in_loop: bool = False) -> list[str]:
    """Return the reasons against each effect on its own.

    Parameters
    ----------
    effects : sequence of FoundEffect
        The effects.
    in_loop : bool
        Whether a controller moves the output.
    """
    reasons = []
    for effect in effects:
        confidence = effect.confidence if in_loop or effect.at_its_place is None else effect.at_its_place
        if confidence <= LIKELIER or effect.confidence < ONE_OTHER:
            reasons.append(f"{effect.name} is a hypothesis: its confidence is {effect.confidence:.0%}")
        name = _open_amount(effect)
        if name:
            low, high = effect.interval95[name]
            reasons.append(
                f"{effect.name} is a hypothesis: the record leaves its {name} open ({low:.3g} to {high:.3g})"
            )
    return reasons


def doubts_about_process(
    before: ProcessModel, after: ProcessModel, covariance: FloatArray | None, *, in_loop: bool = False
) -> list[str]:
    """Return the reasons against the process without the effects, for which gains are designed."""
    if in_loop and before.K * after.K < 0.0:
        return ["the sign of the gain depends on what is assumed beside the process"]
    if covariance is None:
        return []
    values = after.parameters()
    answer = (DAMPING,) if DAMPING in values else TIMES
    return [
        f"the record leaves the {words} of the process beside the effects open"
        for words, names in (("gain", ("K",)), ("damping" if DAMPING in values else "answer time", answer))
        if not _is_bounded(values, names, covariance)
    ]


def doubts_about_errors(selection: Misfit, later: Misfit) -> list[str]:
    """Return the reasons against the effects from the held-out part; `later` is its later half."""
    reasons = []
    if selection.after > max(selection.before, VISIBLE * selection.expected):
        reasons.append("the effects make the error on the selection part larger")
    if later.after > FEW * later.expected:
        ratio = later.after / max(later.expected, SMALLEST_DIVISOR)
        reasons.append(
            f"the error grows to {ratio:.1f} times what noise leaves on the later half of the selection part"
        )
    return reasons


def doubts_about_readings(grid: Grid | None, pv: FloatArray) -> list[str]:
    """Return why the readings of a sensor that reports on change show no process: repeated ones lag like play."""
    if grid is None or not grid.sends:
        return []
    count = int(np.count_nonzero(new_readings(pv)))
    return [f"the sensor sent {count} new readings only: they leave the process open"] if count < FEWEST_NEW else []


def doubts_about_moments(effects: Sequence[FoundEffect], dataset: Dataset, delay_s: float) -> list[str]:
    """Return the loads and drifts that coincide with the response to a move of the output, and may be its error.

    A drift that settles bends slowly: its beginning is known to within its interval only.
    """
    return [
        f"{effect.name} is a hypothesis: it begins or ends where a move of the output arrives"
        for effect in effects
        if (effect.name == LOAD and answers_a_move(effect.parameters, dataset, delay_s))
        or (effect.name == DRIFT and answers_a_move(effect.parameters, dataset, delay_s, _error_of_beginning(effect)))
    ]


def doubts_about_course(context: FitContext, chosen: Fitted) -> list[str]:
    """Return why a load of free shape alone is no explanation: it follows whatever the fitted part has."""
    if not is_free_load(context, chosen):
        return []
    return [f"{chosen.reported_names()[0]} is a hypothesis: a load of free shape predicts nothing of what follows"]


def _error_of_beginning(effect: FoundEffect) -> float:
    """Return half the width of the interval of the time at which an effect begins, s; 0 without one."""
    ends = [effect.interval95[name] for name in BEGINS if name in effect.interval95]
    return (ends[0][1] - ends[0][0]) / 2.0 if ends else 0.0


def _open_amount(effect: FoundEffect) -> str:
    """Return the first amount of an effect of which none is bounded; empty where one is, or none has an interval."""
    units = effect.units
    known = [name for name in effect.parameters if name in effect.interval95]
    amounts = [name for name in known if units[name] != "s"] or known
    for name in amounts:
        low, high = effect.interval95[name]
        if (high - low) / 2.0 <= MOST_OPEN * abs(effect.parameters[name]):
            return ""
    return amounts[0] if amounts else ""


def _is_bounded(values: Mapping[str, float], names: Sequence[str], covariance: FloatArray) -> bool:
    """Return whether the sum of some parameters is determined by the record."""
    weights = np.array([float(name in names) for name in values])
    half = NORMAL_95 * math.sqrt(max(float(weights @ covariance @ weights), 0.0))
    return half <= MOST_OPEN * abs(sum(values[name] for name in names if name in values))
