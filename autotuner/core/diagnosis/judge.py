"""When an effect is believed.

    gain       fall of the criterion
    held out   S_after < q S_before on the part not fitted, or
               d = e_before^2 - e_after^2,   mean d > Z s(d) sqrt(inflation/n)
    share      (S_before - S_after)/(S_before - noise^2), of what there is to explain

An effect has to win on all three: the first keeps noise from being named, the second keeps a flexible form from being
named that only follows the record, the third keeps a second name from being invented to mend the shape of the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.linear import residual_after
from autotuner.core.identification.motions import Lag
from autotuner.core.signals.noise import inflation

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.case import Case
    from autotuner.core.diagnosis.extended import Fitted

GAIN = 14.0
"""Fall of the criterion that one more effect has to bring."""
SURE = 1.6
"""Standard errors by which the part that was not fitted has to be explained better."""
MUCH_BETTER = 0.75
"""Ratio of the squares on the part not fitted under which their standard error is not asked for."""
LEAST_FALL = 0.06
"""Relative fall of the mean square under which nobody would care."""
FIRST_SHARE, FURTHER_SHARE = 0.5, 0.6
"""Share of what there is to explain that an effect has to explain."""
VISIBLE = 1.3
"""Misfit over noise from which a residual that follows the output is called a misfit."""
DRIVEN = 45.0
"""`n ln` of the squares before over after from which a residual is held to follow the output: 12 columns, 1e-5."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for one explanation against a simpler one.

    Attributes
    ----------
    gain : float
        Fall of the criterion.
    held_out_ratio : float
        Squares on the part not fitted, after over before.
    held_out_z : float
        Their fall in standard errors.
    share : float
        Share of what there was to explain.
    fall : float
        Relative fall of the mean square on the fitted part.
    """

    gain: float
    held_out_ratio: float
    held_out_z: float
    share: float
    fall: float


def noise_of(case: Case) -> float:
    """Return what counts as noise, PV: that of the sensor, and what no model explains."""
    return math.hypot(case.noise, case.floor)


def weigh(bench: Bench, before: Fitted, after: Fitted) -> Evidence:
    """Return what speaks for `after`, which has one effect more than `before`."""
    case = bench.case
    inflated = bench.colour(after)
    left = case.floor**2
    noise = min(noise_of(case) ** 2, after.mean_square)
    there = max(before.mean_square - noise, 1e-300)
    return Evidence(
        bench.criterion(before, inflated) - bench.criterion(after, inflated),
        *held_out_gain(bench, before, after),
        (before.mean_square - after.mean_square) / there,
        1.0 - (after.mean_square + left) / (before.mean_square + left),
    )


def held_out_gain(bench: Bench, before: Fitted, after: Fitted) -> tuple[float, float]:
    """Return the squares on the part not fitted, after over before, and their fall in its standard errors."""
    left = bench.case.floor**2
    first, second = bench.held_out_residual(before) ** 2, bench.held_out_residual(after) ** 2
    d = first - second
    z = float(d.mean()) / ((float(np.std(d)) + left) * math.sqrt(inflation(d - d.mean()) / d.size))
    return (float(second.mean()) + left) / (float(first.mean()) + left), z


def is_believed(evidence: Evidence, *, first: bool, seen_held_out: bool) -> bool:
    """Return whether an effect is named."""
    share = FIRST_SHARE if first else FURTHER_SHARE
    return (
        evidence.gain > GAIN
        and evidence.fall > LEAST_FALL
        and evidence.share > share
        and (evidence.held_out_ratio < MUCH_BETTER or evidence.held_out_z > SURE or not seen_held_out)
    )


def driven(case: Case, residual: FloatArray, rows: np.ndarray) -> float:
    """Return by how much the output's moves explain a residual: `n ln(S_before/S_after)`, `n` independent samples.

    The columns are the moves, their sizes and their directions, each through three lags.
    """
    held = case.data.held
    t = case.data.t[rows]
    steps = held.steps
    columns = [np.ones(t.size)]
    for weight in (steps, np.abs(steps), np.sign(steps), steps**2):
        train = type(held)(held.times, np.cumsum(weight) - weight[0])
        columns += [Lag(share * case.span_s).forced(train, t)[1][0] for share in (0.005, 0.02, 0.08)]
    left = residual_after(np.column_stack(columns), residual)
    before = float(np.sum((residual - residual.mean()) ** 2)) + residual.size * case.floor**2
    after = float(left @ left) + residual.size * case.floor**2
    return residual.size / inflation(left) * math.log(before / after)
