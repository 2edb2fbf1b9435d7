"""Acceptance of an effect.

    gain       decrease of the criterion
    held out   S_after < q S_before on the part not fitted, or
               d = e_before^2 - e_after^2,   mean d > Z s(d) sqrt(inflation/n)
    share      (S_before - S_after)/(S_before - noise^2), of the explainable part
    weight     (S_before - S_after)/(S_alone - S_after), of the part that all effects explain

An effect must pass all of them: the first one excludes noise, the second one a flexible form that only follows the
fitted part, the others a second name that only corrects the shape of the first one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.free_forms import free_load_after
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.record.dataset import FEWEST_AT_REST, FLOOR, noise_at_rest
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.quantiles import NORMAL_99
from autotuner.core.signals.noise import inflation, noise_sigma, rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

GAIN = 14.0
"""Fall of the criterion that one more effect has to bring."""
SURE = 1.6
"""Standard errors of the improvement on the held-out part."""
MUCH_BETTER = 0.75
"""Ratio of the squares on the held-out part below which their standard error is not computed."""
CONFIRMED = ((0.5, 1.6), (0.7, 2.5))
"""Ratio of the squares on the held-out part, and its standard errors, from which the criterion is not computed: with a
strongly coloured residual, a record has few independent samples."""
HELPFUL, MUCH_GAIN = 0.8, 60.0
"""The same ratio for the acceptance of a measured disturbance; and the gain from which it need not improve there."""
WORSE = 1.5
"""The same ratio from which an effect that need not be visible there is rejected."""
MOST_UNSURE = 4.0
"""Misfit on the held-out part, over the noise, up to which it may be explained by the errors of the numbers."""
LEAST_SHOWN = 1e-5
"""Smallest relative decrease of the squares: the end of a search, and rounding, contribute less."""
LEAST_FALL = 0.06
"""Relative decrease of the mean square that is negligible in practice."""
FIRST_SHARE, FURTHER_SHARE = 0.45, 0.6
"""Share of the explainable part that an effect must explain."""
LEAST_WEIGHT = 0.04
"""Weight below which a further effect only corrects the form of the first one, unless only noise remains."""
FAINT = 2e-3
"""Weight below which this holds, too, unless both parts have only noise left: without noise, any form may be
corrected."""
PREDICTED = 0.02
"""The same weight on the held-out part, from which an effect that leaves only noise is accepted."""
SEVERAL = 2
"""Effects, but for measured ones, beside which a further one has to complete the explanation."""
HALVED = 0.5
"""Ratio of the misfits on the held-out part up to which a further effect predicts it."""
NOISE_ELSEWHERE = 1.25
"""Ratio of misfit to noise on the held-out part, often short, below which it has nothing but noise."""
OF_TIME = frozenset({Place.DISTURBANCE, Place.SENSOR})
"""Places of effects that are functions of time, which no move of the output changes."""
NOTHING_LEFT, VISIBLE = 1.12, 1.5
"""Ratio of misfit to noise that counts as noise, and from which a model is never called adequate."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for one explanation against a simpler one.

    Attributes
    ----------
    gain : float
        Decrease of the criterion.
    held_out_ratio : float
        Squares on the part not fitted, after over before.
    held_out_z : float
        Their fall in standard errors.
    share : float
        Share of the explainable part.
    fall : float
        Relative fall of the mean square on the fitted part.
    quiet : bool
        Whether the part not fitted holds nothing but noise before, and all but that after.
    foreseen : bool
        Whether the explanation leaves only noise on the fitted part, and elsewhere as much as the errors of its numbers
        make.
    """

    gain: float
    held_out_ratio: float
    held_out_z: float
    share: float
    fall: float
    quiet: bool = False
    foreseen: bool = False


def noise_of(context: FitContext, candidate: Fitted) -> float:
    """Return the noise level, PV: that of the sensor by this candidate, and unexplainable errors."""
    dataset = context.dataset
    sigma = noise_sigma(candidate.residual)
    resting = candidate.problem.rows < dataset.at_rest
    if np.count_nonzero(resting) >= FEWEST_AT_REST:
        sigma = noise_at_rest(sigma, candidate.residual[resting])
    return math.hypot(max(sigma, dataset.grid_noise), dataset.floor)


def is_near_noise(context: FitContext, candidate: Fitted) -> bool:
    """Return whether a candidate leaves about as much of the fitted samples as noise does."""
    return candidate.rms < NOTHING_LEFT * noise_of(context, candidate)


def is_visible(context: FitContext, candidate: Fitted) -> bool:
    """Return whether what a candidate leaves of the fitted samples is more than an adequate model may."""
    return candidate.rms >= VISIBLE * noise_of(context, candidate)


def weigh(context: FitContext, before: Fitted, after: Fitted) -> Evidence:
    """Return the evidence for `after`, which has one effect more than `before`."""
    inflated = context.colour(after)
    left = context.dataset.floor**2
    noise = min(noise_of(context, after) ** 2, after.mean_square)
    there = max(before.mean_square - noise, SMALLEST_DIVISOR)
    ratio, z = held_out_gain(context, before, after)
    return Evidence(
        context.criterion(before, inflated) - context.criterion(after, inflated),
        ratio,
        z,
        (before.mean_square - after.mean_square) / there,
        1.0 - (after.mean_square + left) / (before.mean_square + left),
        _is_quiet(context, before, after, math.sqrt(noise)),
        ratio >= MUCH_BETTER and inflated == 1.0 and is_foreseen(context, after, math.sqrt(noise)),
    )


def _is_quiet(context: FitContext, before: Fitted, after: Fitted, noise: float) -> bool:
    """Return whether the held-out part is uninformative: the effect had faded before it, or is not visible there."""
    first, second = held_out(context, before, after)
    most = by_chance(first.size) * math.hypot(noise, context.dataset.floor)
    return rms(first) < most and rms(second) < most


def by_chance(count: float) -> float:
    """Return the misfit of a number of samples, over the noise, that counts as noise.

    The mean square of `n` samples of noise is off by `sqrt(2/n)` of itself.
    """
    return max(NOTHING_LEFT, math.sqrt(1.0 + NORMAL_99 * math.sqrt(2.0 / count)))


def is_foreseen(context: FitContext, after: Fitted, noise: float) -> bool:
    """Return whether noise is left, and elsewhere what the errors of the numbers make there: not much more than noise.

    These errors add the mean of `j (J'J)^-1 j'` to the variance of a prediction, by that of the noise, `J` and `j` the
    slopes of the simulated PV with all numbers on both parts (Ljung, System Identification, 1999, section 9.2). Of a
    coloured residual, as many samples fewer are independent.
    """
    if after.rms >= NOTHING_LEFT * noise or is_beside_free_load(after):
        return False
    fitted, elsewhere = (
        np.hstack(tangent(replace(after.problem, rows=rows), after.theta))
        for rows in (after.problem.rows, context.held_out)
    )
    spread = elsewhere @ np.linalg.pinv(fitted)
    colour = context.colour(after)
    of_noise = by_chance(elsewhere.shape[0] / colour)
    most = noise * math.sqrt(of_noise**2 + NORMAL_99**2 * colour * float(np.mean(np.sum(spread**2, axis=1))))
    return context.held_out_error(after) < most < MOST_UNSURE * noise


def held_out(context: FitContext, *candidates: Fitted) -> list[FloatArray]:
    """Return the residuals on the part not fitted, less that of a free load beside another effect in the last one.

    A load of free shape predicts nothing after the fitted part. Its error there would hide what the other effect does.
    """
    if not is_beside_free_load(candidates[-1]):
        return [context.held_out_residual(candidate) for candidate in candidates]
    return [without_free_load(context, candidate) for candidate in candidates]


def is_beside_free_load(candidate: Fitted) -> bool:
    """Return whether a load of free shape is one of several effects."""
    effects = candidate.problem.effects
    return len(effects) > 1 and any(effect.reads_as is not None for effect in effects)


def without_free_load(context: FitContext, candidate: Fitted) -> FloatArray:
    """Return the residual on the part not fitted, less what a load of free shape explains there, PV."""
    residual = context.held_out_residual(candidate)
    q, _ = solve_linear(free_load_after(candidate.problem.view(candidate.theta, context.held_out)), residual)
    left: FloatArray = residual - q @ (q.T @ residual)
    return left


def held_out_gain(context: FitContext, before: Fitted, after: Fitted) -> tuple[float, float]:
    """Return the squares on the part not fitted, after over before, and their fall in its standard errors.

    A process that integrates keeps every error of its load: its residual is a random walk, of which a short part has
    few independent samples. There the slopes of the residuals decide, unless the residuals themselves speak against it.
    """
    first, second = held_out(context, before, after)
    ratio, z = _fall_of_squares(first, second, context.dataset.floor)
    if ratio >= 1.0 or not all(c.problem.structure.stiffness == 0.0 for c in (before, after)):
        return ratio, z
    floor = FLOOR * float(np.std(np.diff(context.dataset.data.pv[context.held_out])))
    slopes = _fall_of_squares(np.diff(first), np.diff(second), floor)
    return slopes if slopes[1] > z else (ratio, z)


def _fall_of_squares(before: FloatArray, after: FloatArray, floor: float) -> tuple[float, float]:
    left, first, second = floor**2, before**2, after**2
    d = first - second
    z = float(d.mean()) / ((float(np.std(d)) + left) * math.sqrt(inflation(d - d.mean()) / d.size))
    return (float(second.mean()) + left) / (float(first.mean()) + left), z


def is_supported(evidence: Evidence, *, first: bool, seen_held_out: bool) -> bool:
    """Return whether an effect is named."""
    share = FIRST_SHARE if first else FURTHER_SHARE
    ratio, z = evidence.held_out_ratio, evidence.held_out_z
    confirmed = seen_held_out and evidence.gain > 0.0 and _is_confirmed(evidence)
    unseen = not seen_held_out and ratio < WORSE
    excused = (evidence.quiet or evidence.foreseen) and evidence.gain > MUCH_GAIN
    return (
        (evidence.gain > GAIN or confirmed)
        and evidence.fall > LEAST_FALL
        and evidence.share > share
        and (ratio < MUCH_BETTER or z > SURE or unseen or excused)
    )


def is_helpful(evidence: Evidence) -> bool:
    """Return whether a measured disturbance is accepted: it is not a guess among many."""
    much = evidence.gain > MUCH_GAIN and evidence.held_out_ratio < 1.0
    helps = evidence.gain > GAIN and evidence.held_out_ratio < HELPFUL
    return (helps or much or _is_confirmed(evidence)) and evidence.fall > LEAST_FALL


def _is_confirmed(evidence: Evidence) -> bool:
    return any(evidence.held_out_ratio < most and evidence.held_out_z > least for most, least in CONFIRMED)


def is_shown(before: float, after: float) -> bool:
    """Return whether the squares fall by more than the tolerance of the search and rounding explain."""
    return before - after > LEAST_SHOWN * before


def _part_of_fall(alone: float, before: float, after: float) -> float:
    """Return the last step's part of a fall of squares; 0 where none is shown."""
    return (before - after) / max(alone - after, SMALLEST_DIVISOR) if is_shown(before, after) else 0.0


def weighs_enough(context: FitContext, alone: Fitted, before: Fitted, after: Fitted) -> bool:
    """Return whether a further effect is more than a mend of the first one's form.

    With two effects, a third one follows what their forms leave: it has to leave only noise, or halve both errors.
    """
    weight = _part_of_fall(alone.mean_square, before.mean_square, after.mean_square)
    noise = min(noise_of(context, after), math.sqrt(after.misfit))
    held_alone = context.held_out_error(alone)
    held_before, held_after = (rms(r) for r in held_out(context, before, after))
    there = before.rms > VISIBLE * noise or held_before > 2.0 * VISIBLE * noise
    predicts = held_after < max(VISIBLE * noise, HALVED * held_before) or is_foreseen(context, after, noise)
    silent = after.rms < NOTHING_LEFT * noise and predicts
    completes = silent and there
    confirmed = held_after < VISIBLE * noise < HALVED * held_before and after.rms < HALVED * before.rms
    silences = completes and held_after < NOISE_ELSEWHERE * noise < HALVED * held_before
    predicted = _part_of_fall(held_alone**2, held_before**2, held_after**2)
    third = sum(not effect.measured for effect in after.problem.effects) > SEVERAL
    heavy = weight > LEAST_WEIGHT and not third
    shown = weight > FAINT or predicted > PREDICTED
    visible = silent and before.rms > NOISE_ELSEWHERE * noise
    return heavy or silences or (shown and (completes or confirmed)) or (visible and _acts_otherwise(before, after))


def _acts_otherwise(before: Fitted, after: Fitted) -> bool:
    """Return whether what is new changes how the output acts, where before there were only functions of time.

    It corrects no form of theirs, however small its squares are beside those of a drift.
    """
    kept = before.problem.effects
    names = {e.name for e in kept}
    new = [e for e in after.problem.effects if e.name not in names]
    return bool(kept) and all(e.place in OF_TIME for e in kept) and not any(e.place in OF_TIME for e in new)
