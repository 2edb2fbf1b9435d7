"""The process alone: the best model without effects, and the initial guesses of extended models.

A hidden effect biases the free model, sometimes into another local minimum: a load step resembles an infinite time
constant. The search for effects therefore starts from several process models: the free one, one with a drift, and
one of the relay part or of the second half alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import SHORTEST, Extended, Fitted, closest_first, without_rounding
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.estimation.data import GainPrior
from autotuner.core.estimation.initial_guesses import ringing_shapes, scans
from autotuner.core.identification.controller_inverse import is_inverse
from autotuner.core.model.structures import FOPDT, INTEGRATING, PURE_INTEGRATOR, SECOND_ORDER, UNSTABLE
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.estimation.initial_guesses import Start
    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.model.structures import Structure

STEPS = 30
"""Most steps of the least-squares optimiser, which its own tolerance usually ends before."""
COARSE_STEPS = 12
"""Most steps from one start on thinned data, where only the best start is selected."""
SCANNED = 3
"""Best starts of the scan that are followed."""
NOTHING_LEFT = 1.25
"""Misfit over noise under which processes that do not settle are not tried."""
AS_NEAR = 1.5
"""Misfit of a process with a gain of the other sign, over the best, up to which effects are tried with it too."""
BETTER, FAR = 0.87, 0.5
"""Misfit over that of the pair of lags under which a process that integrates, or one that runs away, is tried too."""
SETTLING: tuple[Structure, ...] = (FOPDT, SECOND_ORDER)
OTHERS: tuple[Structure, ...] = (PURE_INTEGRATOR, INTEGRATING, UNSTABLE)
OPEN_ENDED: tuple[Structure, ...] = (PURE_INTEGRATOR, INTEGRATING)
"""Structures of these for a record that is not an experiment: over such a record, an unstable one diverges."""
INTEGRATORS = {FOPDT: PURE_INTEGRATOR, SECOND_ORDER: INTEGRATING}
"""What a process is whose slowest lag, the first of its numbers, is an integrator."""
FAMILY: dict[str, Structure] = {
    "fopdt": FOPDT,
    "sopdt_overdamped": SECOND_ORDER,
    "sopdt_underdamped": SECOND_ORDER,
    "integrating": INTEGRATING,
}
"""Simulation of a declared model."""
MANY_TIMES = 3.0
"""Ratio of a disturbance to the range of the PV above which it is not an explanation."""
NEARLY = 1.05
"""Ratio of errors up to which the model of one lag is preferred, as the simpler one."""
LIGHTLY_DAMPED, SHORT = 0.2, 0.3
"""Damping ratio below which the ringing of a pair may be a disturbance; the short second lag, in samples."""
CLOSE = 0.15
"""Difference of all logarithms under which two process models count as one place to start from."""


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """The process alone.

    Attributes
    ----------
    best : Fitted
        The best model without effects.
    origins : tuple of Fitted
        Process models from which extended ones start.
    held : Fitted or None
        The declared model as it is, with gain and offset of the record.
    other_sign_rms : float
        Smallest error of a process whose gain has the other sign, PV; infinite where none was tried.
    """

    best: Fitted
    origins: tuple[Fitted, ...]
    held: Fitted | None = None
    other_sign_rms: float = math.inf

    @property
    def alone(self) -> Fitted:
        """The declared model as it is, the best one without it."""
        return self.best if self.held is None else self.held


def base_of(context: FitContext, background: tuple[str, ...], sign: int) -> Base | None:
    """Return the process alone; None when no process comes near the record.

    Parameters
    ----------
    context : FitContext
        The recording.
    background : tuple of str
        What the PV does besides: ``offset``, and ``state`` where the record begins in the middle of a motion.
    sign : int
        Sign of the gain; 0 when unknown.
    """
    prior = GainPrior(None, sign)
    both = [_of_either_sign(context, s, background, sign) for s in SETTLING]
    fits = _pair_at_least_as_good(context, [f for found in both for f in found[:1]])
    noise = math.hypot(context.dataset.noise, context.dataset.floor)
    if not fits or min(f.rms for f in fits) > NOTHING_LEFT * noise or _all_fail_elsewhere(context, fits, noise):
        others = OTHERS if context.dataset.tuned else OPEN_ENDED
    else:
        others = OPEN_ENDED if any(outlasts_the_record(f) for f in fits) else ()
    fits += [f for s in others for f in _alone(context, s, background, [prior])]
    if not fits:
        return None
    best = context.best(fits)
    opposite = closest_first(f for found in both for f in found if float(f.linear[0]) * float(best.linear[0]) < 0.0)
    other_sign_rms = min((f.rms for f in opposite), default=math.inf)
    near = opposite[:1] if best.rms > NOTHING_LEFT * noise and other_sign_rms < AS_NEAR * best.rms else []
    return Base(best, (*_origins(context, fits, best, prior), *near), other_sign_rms=other_sign_rms)


def outlasts_the_record(settling: Fitted) -> bool:
    """Return whether a process has a lag that is longer than the fitted part: there, it may integrate as well."""
    problem = settling.problem
    slowest_s = problem.split(settling.theta)[0][0]  # one lag, or the sum of two
    return slowest_s > problem.dataset.fitted_until_s


def _all_fail_elsewhere(context: FitContext, fits: Sequence[Fitted], noise: float) -> bool:
    """Return whether all processes that settle fail on the part that was not fitted, of a record that is no experiment.

    The fitted part of a short one looks alike for a process that integrates and one that settles very late.
    """
    return not context.dataset.tuned and all(context.held_out_error(f) > NOTHING_LEFT * noise for f in fits)


def _of_either_sign(context: FitContext, structure: Structure, background: tuple[str, ...], sign: int) -> list[Fitted]:
    """Return the best process of each sign, the best first.

    For a periodic record the other sign with half a period of delay is similar, but is less often right on the
    held-out part.
    """
    priors = [GainPrior(None, s) for s in ((sign,) if sign else (1, -1))]
    found = closest_first(_alone(context, structure, background, priors))
    return found if context.dataset.tuned else without_rounding(found, context.on_both_parts)


def _pair_at_least_as_good(context: FitContext, fits: list[Fitted]) -> list[Fitted]:
    """Return the fits, with the pair of lags restarted from the single one where this is closer."""
    single = next((f for f in fits if f.problem.structure is FOPDT), None)
    pair = next((f for f in fits if f.problem.structure is SECOND_ORDER), None)
    if single is None or (pair is not None and pair.rms <= single.rms * NEARLY):
        return fits
    problem = replace(single.problem, structure=SECOND_ORDER, rows=context.fine)
    again = fit(problem, _as_pair(context, single), STEPS)
    return [single, *([again] if is_physical(again) else [])]


def declared_base(context: FitContext, background: tuple[str, ...], sign: int, model: ProcessModel) -> Base | None:
    """Return the declared model as it is, and with other values; None for a structure that cannot be simulated here."""
    structure = next((s for kind, s in FAMILY.items() if model.structure == kind), None)
    if structure is None:
        return None
    problem = Extended(context.dataset, structure, (), context.fine, background)
    r = model.rational()
    n, m = r.a[1], r.a[2]
    shape = {"fopdt": [n], "integrating": [m]}.get(model.structure, [n, m / n])
    least = SHORTEST * context.dataset.data.interval_s
    theta = np.array([*np.log(np.maximum(shape, least)), model.D / problem.unit_s])
    held = fit(replace(problem, fixed=tuple(theta.tolist())), theta, 0)
    prior = GainPrior(None, sign)
    free = [f for f in (fit(problem, theta, STEPS), *_alone(context, structure, background, [prior])) if is_physical(f)]
    refit = next(iter(closest_first(free)), held)
    best = context.best([held, refit])
    return Base(best, (held, refit), held)


def _alone(
    context: FitContext, structure: Structure, background: tuple[str, ...], priors: Sequence[GainPrior]
) -> list[Fitted]:
    """Return the best process of a structure by each prior."""
    problem = Extended(context.dataset, structure, (), context.coarse, background)
    fine = [
        (fit(replace(problem, rows=context.fine), coarse[0].theta, STEPS), prior)
        for coarse, prior in zip(_from_scan(context, problem, priors, context.coarse), priors, strict=True)
        if coarse
    ]
    return [f for f, prior in fine if is_physical(f, prior)]


def _from_scan(
    context: FitContext, problem: Extended, priors: Sequence[GainPrior], rows: IntArray
) -> list[list[Fitted]]:
    """Return for each prior the fits from the best starts of the scan on some samples, the best first."""
    dataset = context.dataset
    data = replace(dataset.data, t=dataset.data.t[rows], pv=dataset.data.pv[rows], weight=np.ones(rows.size))
    background = ("offset", "drift") if "drift" in problem.background else ("offset",)
    ringing = _ringing(dataset, problem.structure)
    starts = [found[:SCANNED] for found in scans(data, problem.structure, background, priors, ringing)]
    if dataset.in_loop and "state" in problem.background:
        # A load that was there before the record hides the process that removes it.
        with_state = scans(data, problem.structure, (*background, "state"), priors, ringing)
        starts = [[*found, *more[:1]] for found, more in zip(starts, with_state, strict=True)]
    some = replace(problem, rows=rows)
    return [
        closest_first(f for s in found if is_physical(f := fit(some, theta_of(some, s), COARSE_STEPS), prior))
        for found, prior in zip(starts, priors, strict=True)
    ]


def theta_of(problem: Extended, start: Start) -> FloatArray:
    """Return the numbers of a process without effects at a start."""
    return np.array([*np.log(start.shape), start.delay_s / problem.unit_s])


def _ringing(dataset: Dataset, structure: Structure) -> list[tuple[float, float]]:
    """Return oscillating shapes from the fitted part of a record that is not an experiment of known shape."""
    if dataset.tuned or structure is not SECOND_ORDER:
        return []
    rows = np.flatnonzero(dataset.fitted)
    t, held = dataset.data.t[rows], dataset.data.held
    return ringing_shapes(t, held.at(t), dataset.data.pv[rows])


def _origins(context: FitContext, fits: Sequence[Fitted], best: Fitted, prior: GainPrior) -> list[Fitted]:
    """Return where extended models start: the free pair, pairs of parts of the record, another structure.

    A pair that outlasts the record comes last, and what integrates there first.
    """
    pair = next((f for f in fits if f.problem.structure is SECOND_ORDER), None)
    if pair is None:
        return [best]
    origins = [pair]
    if best.rms > NOTHING_LEFT * math.hypot(context.dataset.noise, context.dataset.floor):
        origins += [*_of_parts(context, pair, prior), *_without_jumps(context, pair, prior)]
        origins += [_of_one_lag(context, f) for f in fits if f.problem.structure is FOPDT and _is_lightly_damped(pair)]
    integrating = next((f for f in fits if f.problem.structure is INTEGRATING), None)
    if integrating is not None and outlasts_the_record(pair):
        return [*_distinct([integrating, *map(_as_it_shows, origins[1:])]), pair]
    others = [f for f in fits if f.problem.structure in OTHERS]
    better = [f for f in others if f.rms < (FAR if f.problem.structure is UNSTABLE else BETTER) * pair.rms]
    return [*_distinct(origins), *closest_first(better)[:1]]


def _as_it_shows(origin: Fitted) -> Fitted:
    """Return a pair that outlasts the record as what it is there, of which many pairs are alike: an integrator."""
    return with_integrator(origin, 0) if outlasts_the_record(origin) else origin


def with_integrator(settling: Fitted, steps: int) -> Fitted:
    """Return a process, with its effects, fitted with an integrator in place of its slowest lag."""
    problem = replace(settling.problem, structure=INTEGRATORS[settling.problem.structure])
    return fit(problem, settling.theta[1:], steps)


def _is_lightly_damped(pair: Fitted) -> bool:
    """Return whether a pair rings for many periods, as a disturbance that is periodic may look."""
    (n, ratio), _, _ = pair.problem.split(pair.theta)
    return n < 4.0 * LIGHTLY_DAMPED**2 * ratio  # zeta = n/(2 sqrt(m)), and ratio = m/n


def _of_one_lag(context: FitContext, single: Fitted) -> Fitted:
    """Return one lag as a pair with a short second one."""
    return fit(replace(single.problem, structure=SECOND_ORDER, rows=context.coarse), _as_pair(context, single), 0)


def _as_pair(context: FitContext, single: Fitted) -> FloatArray:
    """Return the numbers of one lag with a short second one."""
    theta: FloatArray = np.insert(single.theta, 1, math.log(SHORT * context.dataset.data.interval_s))
    return theta


def _of_parts(context: FitContext, pair: Fitted, prior: GainPrior) -> list[Fitted]:
    rows = context.coarse
    half = rows.size // 2
    wandering = replace(pair.problem, background=("offset", "drift"))
    found = []
    for part in (rows, rows[:half], rows[half:]):
        problem = replace(wandering, background=("offset", "drift", "state")) if part[0] > rows[half - 1] else wandering
        found += [_moved(context, pair, near) for near in _from_scan(context, problem, [prior], part)[0][:1]]
    return found


def _without_jumps(context: FitContext, pair: Fitted, prior: GainPrior) -> list[Fitted]:
    """Return the pair fitted to the record without possible jumps of the reading; empty without any jump."""
    dataset = context.dataset
    jumps = dataset.visible_jumps
    if not jumps:
        return []
    jumped = sum(size * (dataset.data.t > at_s) for at_s, size in jumps)
    smooth = replace(dataset, data=replace(dataset.data, pv=dataset.data.pv - jumped))
    problem = replace(pair.problem, dataset=smooth)
    found = _from_scan(replace(context, dataset=smooth), problem, [prior], context.coarse)[0]
    return [_moved(context, pair, near) for near in found[:1]]


def _moved(context: FitContext, pair: Fitted, near: Fitted) -> Fitted:
    """Return the pair's problem at the process of another fit."""
    return fit(replace(pair.problem, rows=context.coarse), near.theta, 0)


def _distinct(origins: Sequence[Fitted]) -> list[Fitted]:
    kept: list[Fitted] = []
    for origin in origins:
        if not any(_is_close(origin, other) for other in kept):
            kept.append(origin)
    return kept


def _is_close(one: Fitted, other: Fitted) -> bool:
    """Return whether two processes of one structure are one place to start from."""
    alike = one.problem.structure is other.problem.structure
    return alike and float(np.abs(one.theta - other.theta).max()) <= CLOSE


def is_physical(candidate: Fitted, prior: GainPrior | None = None) -> bool:
    """Return whether it is a valid process model, with the known sign of the gain, valid shares and limits."""
    try:
        candidate.process()
    except (InputError, ValueError, OverflowError):
        return False
    if not has_sensible_sizes(candidate) or not candidate.is_meaningful():
        return False
    if candidate.problem.effects and is_the_controller(candidate):
        return False
    allowed = prior is None or prior.allows(float(candidate.linear[0]))
    return allowed and math.isfinite(candidate.mean_square)


def is_the_controller(candidate: Fitted) -> bool:
    """Return whether a process, with the zero beside it, is the inverse of the controller that moves the output."""
    controller = candidate.problem.dataset.controller
    if controller is None:
        return False
    zero_s = next((sizes["Z"] for sizes in candidate.sizes() if "Z" in sizes), 0.0)
    return is_inverse(candidate.process(), controller, zero_s)


def has_sensible_sizes(candidate: Fitted) -> bool:
    """Return whether shares are in range, limits in order, and disturbances not many times the range of the PV.

    Two disturbances that cancel each other explain anything.
    """
    dataset = candidate.problem.dataset
    seen = float(np.ptp(dataset.data.pv))
    for effect, sizes in zip(candidate.problem.effects, candidate.sizes(), strict=True):
        most = {"load_step": dataset.swing, "bias_step": seen, "drift": seen}.get(effect.name, math.inf)
        size = sizes.get("size", sizes.get("pv_in_all", 0.0))
        limits = sizes.get("low", -math.inf), sizes.get("high", math.inf)
        if not 0.0 <= sizes.get("share", 0.0) <= 1.0 or limits[0] >= limits[1] or abs(size) > MANY_TIMES * most:
            return False
    return True
