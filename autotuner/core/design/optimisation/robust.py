"""The controller with the smallest integrated error inside limits of robustness and noise.

    minimise  IAE = integral |e(t)| dt   after a unit step of load (or set point)
    over      Ti, Td, Tf, with Kp the largest that keeps Ms, Mt and the jitter of the output

For given times the largest gain follows in closed form (`gain_limits`), so the search runs over the times alone.
Frequency responses carry the exact dead time; nothing is random. The problem is that of Garpinger and Hagglund (J.
Process Control 24, 2014); the elimination of the gain is the step that makes it quick.

With the covariance of the model, the limits hold on the worst models of its 95 % region as well, which are found along
the gradient of each sensitivity (`autotuner.core.design.optimisation.uncertainty`).

Invariants: a search works on grids, and its result is checked on refined ones; a limit that the process does
not allow is relaxed as far as needed, and the result reports it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.design.loop_margins import Margins, margins
from autotuner.core.design.optimisation.loop_grid import SHORTEST_SHARE, loop_grid
from autotuner.core.design.optimisation.search import Search, best_controller
from autotuner.core.design.optimisation.uncertainty import (
    Interval,
    checked_covariance,
    gain_intervals,
    outside_limits,
    worst_models,
)
from autotuner.core.design.requirements import Purpose, Requirements
from autotuner.core.design.rules.ultimate import ultimate_point
from autotuner.core.model.process import Integrating, sum_of_lags
from autotuner.core.notes import Note
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.optimisation.loop_grid import LoopGrid
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

GRID_RESERVE = 0.998
"""Reserve of the search, as a share of `M - 1`, for peaks between its frequencies."""
RELAXED = (1.4, 1.6, 1.8, 2.0, 2.3, 2.6, 3.0, 3.5, 4.0)
"""Sensitivities that are tried when the process does not allow the requested one."""
ROUNDS = 3
"""Most iterations of finding the worst models and designing for them."""
LARGEST_DEAD_TIME_RATIO = 1000.0
"""Dead time to all lags: beyond, a model is a pure delay and its lags are noise."""
NOTABLE, COSTLY, USELESS = 1.1, 1.5, 30.0
"""Factors by which uncertainty may raise the error before a note, before a warning, and before no gains are given."""


@dataclass(frozen=True, slots=True)
class Design:
    """A controller with its results on the model.

    Attributes
    ----------
    gains : PidGains
        The controller.
    margins : Margins
        Its robustness on the model.
    iae : float
        Integral of the absolute error after a unit load step at the process input, PV s/output; infinite without
        integral action.
    overshoot : float
        Largest excess of the PV over a set-point step, share of the step.
    requirements : Requirements
        What was kept; its sensitivities are larger than requested where the process does not allow the requested ones.
    intervals : dict of str to Interval
        95 % intervals of `Kp`, `Ti`, `Td`, `Tf`; empty without a covariance.
    warnings : tuple of str
        Limits relaxed, gains calmed by uncertainty, the price of a fixed set-point weight.
    load_error_cost : float
        Error after a load step by that of the design without a limit of the overshoot.
    """

    gains: PidGains
    margins: Margins
    iae: float
    overshoot: float
    requirements: Requirements
    intervals: dict[str, Interval]
    warnings: tuple[str, ...]
    load_error_cost: float = 1.0


def design(
    model: ProcessModel, requirements: Requirements | None = None, covariance: FloatArray | None = None
) -> Design:
    """Return the controller with the smallest integrated error inside the requirements.

    Parameters
    ----------
    model : ProcessModel
        The process, with a dead time above 0.
    requirements : Requirements, optional
        Limits, purpose and allowed parts of the controller.
    covariance : array of float, shape (p, p), optional
        Covariance of the model's parameters in the order of `ProcessModel.parameters`.

    Raises
    ------
    InputError
        The dead time is zero or far over the lags, the process is unstable and its dead time too long for any PID
        controller, no controller keeps the limits, the covariance is invalid, or the process is so uncertain that
        robust gains would hardly act.
    """
    requested = requirements or Requirements()
    sigma = None if covariance is None else checked_covariance(model, covariance)
    if requested.device is None or not math.isfinite(requested.overshoot):
        return _within(model, requested, sigma)
    first = _within(model, replace(requested, overshoot=math.inf), sigma)
    if first.overshoot <= requested.overshoot:
        return first
    return _with_cost(_within(model, requested, sigma), first, requested.device.b)


def _with_cost(found: Design, first: Design, b: float) -> Design:
    """Return the design with a note on the cost of the device's fixed set-point weight."""
    cost = found.iae / first.iae if math.isfinite(first.iae) else 1.0
    note = (
        f"the device's set-point weight is fixed at {b:g}: the gains are chosen for an overshoot of "
        f"{100.0 * found.overshoot:.0f} % instead of {100.0 * first.overshoot:.0f} %, and the error after a load step "
        f"is {cost:.2f} times as large"
    )
    return replace(found, warnings=(*found.warnings, note), load_error_cost=cost)


def _within(model: ProcessModel, requested: Requirements, sigma: FloatArray | None) -> Design:
    """Return the best controller inside the limits, relaxed as far as the process needs."""
    Pu = _ultimate_period(model)
    grid = loop_grid(model)
    for M in (0.0, *(M for M in RELAXED if max(requested.Ms, requested.Mt) < M)):
        relaxed = replace(requested, Ms=max(M, requested.Ms), Mt=max(M, requested.Mt))
        nominal = best_controller(Search(grid, (), relaxed, GRID_RESERVE), Pu)
        gains = nominal if nominal is None or sigma is None else _suited(grid, relaxed, Pu, nominal, sigma)
        if gains is not None and nominal is not None:
            return _described(grid, gains, nominal, requested, relaxed, sigma)
    raise InputError(
        f"allows no {requested.controller} controller with sensitivities up to {RELAXED[-1]:g} and the other limits",
        field="model",
        value=model,
        remedy="Allow more jitter of the output, or identify the process more exactly.",
    )


def _ultimate_period(model: ProcessModel) -> float:
    """Return the period at which the process would oscillate, after checking that there is one."""
    lags = sum_of_lags(model)
    short = SHORTEST_SHARE * lags >= model.D
    point = None if short else ultimate_point(model)
    refusals = {
        "is so short that nothing limits the gain": short,
        "is too long: no PID controller stabilises this process": point is None,
        f"is over {LARGEST_DEAD_TIME_RATIO:g} times the lags, which no record can distinguish from a pure delay": (
            lags * LARGEST_DEAD_TIME_RATIO < model.D and not isinstance(model, Integrating)
        ),
    }
    reason = next((reason for reason, holds in refusals.items() if holds), None)
    if point is not None and reason is None:
        return point.Pu
    raise InputError(
        str(reason),
        field="model.D",
        value=model.D,
        remedy="Give the sample time of the controller, whose half counts as dead time, or identify again.",
    )


def _suited(
    grid: LoopGrid, requirements: Requirements, Pu: float, gains: PidGains, sigma: FloatArray
) -> PidGains | None:
    """Return the controller that keeps the limits on the worst models of the 95 % region as well."""
    others: list[ProcessModel] = []
    suited: PidGains | None = gains
    for _ in range(ROUNDS):
        assert suited is not None  # noqa: S101 - narrows the type
        worst = worst_models(grid.model, suited, sigma, grid.w, requirements)
        outside = [other for other in worst if outside_limits(other, suited, grid.w, requirements)]
        if not outside:
            break
        others.extend(outside)
        search = Search(grid, others, requirements, GRID_RESERVE)
        suited = best_controller(search, Pu, suited) or best_controller(search, Pu)
        if suited is None:
            break
    return suited


def _of_more_time(grid: LoopGrid, relaxed: Requirements, gains: PidGains, nominal: PidGains, sigma: FloatArray) -> str:
    """Return the benefit of a test of twice the duration: half the variance of all parameters."""
    Pu = _ultimate_period(grid.model)
    longer = _suited(grid, relaxed, Pu, nominal, sigma / 2.0)
    if longer is None:
        return ""
    search = Search(grid, (), relaxed, GRID_RESERVE)
    benefit = 1.0 - search.load_iae(longer) / search.load_iae(gains)
    return f"; a test of twice the time: {100.0 * benefit:.0f} % less load error" if benefit > 0.0 else ""


def _too_unsure(model: ProcessModel, cost: float) -> InputError:
    return InputError(
        f"is not known well enough: gains that stay robust over its 95 % region would hardly act: {cost:.3g} times "
        "the error after a load step",
        field="model",
        value=model,
        remedy="Move the output by more, or record for longer; with a declared structure fewer parameters are open.",
    )


def _described(
    grid: LoopGrid,
    gains: PidGains,
    nominal: PidGains,
    requested: Requirements,
    relaxed: Requirements,
    sigma: FloatArray | None,
) -> Design:
    search = Search(grid, (), relaxed, GRID_RESERVE)
    free = relaxed.device is None and relaxed.purpose is Purpose.LOAD and gains.Ki != 0.0
    weighted = replace(gains, b=grid.set_point_weight(gains)) if free else gains
    warnings = []
    if relaxed.Ms > requested.Ms or relaxed.Mt > requested.Mt:
        warnings.append(
            f"the process allows no sensitivity of {max(requested.Ms, requested.Mt):g} with these limits; "
            f"the gains keep {relaxed.Ms:g} for Ms and {relaxed.Mt:g} for Mt"
        )
    cost = search.load_iae(gains) / search.load_iae(nominal) if gains.Ki and nominal.Ki else 1.0
    if cost > USELESS:
        raise _too_unsure(grid.model, cost)
    if cost > NOTABLE and sigma is not None:
        more = _of_more_time(grid, relaxed, gains, nominal, sigma)
        notes = (
            "the model is not known well enough: to stay robust over its 95 % region the gains are calmer, and the "
            f"error after a load step is {cost:.2f} times that of a process known exactly{more}"
        )
        warnings.append(notes if cost > COSTLY else Note(notes))
    return Design(
        gains=weighted,
        margins=margins(grid.model, weighted),
        iae=search.load_iae(gains),
        overshoot=grid.overshoot(weighted) if gains.Ki else 0.0,
        requirements=relaxed,
        intervals={} if sigma is None else gain_intervals(grid.model, gains, sigma, grid.w, relaxed),
        warnings=tuple(warnings),
    )
