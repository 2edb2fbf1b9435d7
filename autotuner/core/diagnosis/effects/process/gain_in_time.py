"""A gain of the process that changes with time.

    + c G[v s(t)],   s = t                  straight
                         1 - e^(-t/tau)     settling: fouling that is removed as fast as it comes
                         step(t - ts)       jump
                         sum_j c_j H_j(t)   free: straight pieces between a few knots

with `v` the input where it arrives: the dead time is before the process. (Kern, Seaton, British Chemical Engineering 4,
1959, for the form that settles.) What changes with the gain is all that the output makes of the PV, which is nothing at
another output `u*` than the first one, `u0`, as a rule, such as zero:

    + c G[(v + u0 - u*) s(t)]
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.free_forms import by_chance, moment_of
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.zoh_input import HeldInput, unit_step

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Curve = Callable[[FloatArray], FloatArray]
    CurveOf = Callable[[Sequence[float]], tuple[Curve, Sequence[float]]]

PIECES = 100
"""Steps in which a curve of time is written."""
KNOTS, MOMENTS = 4, tuple(np.linspace(0.08, 0.92, 12).tolist())
"""Knots of a free gain; starts of the time of a jump, as shares of the fitted part."""
SETTLING = (0.1, 0.25, 0.6)
"""Starts of the time constant, as shares of the record."""


def gains_in_time(dataset: Dataset) -> tuple[Effect, ...]:
    """Return the forms; a free one needs more moves than it has knots, with fewer it follows whatever they meet."""
    moves = np.count_nonzero(dataset.data.held.times[1:] < dataset.fitted_until_s)
    settling = _settling(dataset)
    free = (replace(_free(dataset), other_forms=(settling,)),) if moves > KNOTS else ()
    return _straight(dataset), settling, *free, _jump(dataset)


def times_curve(held: HeldInput, span_s: float, until_s: float, curve: Curve, also: Sequence[float] = ()) -> HeldInput:
    """Return an input times curves of time, in small steps about their middle, and at some further times.

    A record of `span_s` is searched, and simulated until `until_s`, the end of the part that is kept for the test.
    """
    piece = (span_s - held.times[0]) / PIECES
    end = max(until_s, float(held.times[-1]) + piece)
    edges = np.union1d(held.times, np.append(np.arange(held.times[0], end, piece), also))
    levels = held.at(edges) * curve((edges + np.append(edges[1:], end)) / 2.0)
    return HeldInput(np.append(edges[0], edges), np.concatenate((np.zeros_like(levels[..., :1]), levels), axis=-1))


def _changed(view: View, curve: Curve, also: Sequence[float] = ()) -> FloatArray:
    """Return the response to the input, as it arrives, times a curve of time, or several."""
    return _response(view, view.position.shifted(np.array(view.delay_s)), curve, also)


def _response(view: View, arriving: HeldInput, curve: Curve, also: Sequence[float]) -> FloatArray:
    until_s = float(view.dataset.data.t[-1])
    return view.forced(times_curve(arriving, view.dataset.span_s, until_s, curve, also), delayed=False)


def _along(curve_of: CurveOf, dataset: Dataset, form: Effect) -> Effect:
    """Return a form whose gain follows a curve of time; in its place, another output is tried about which it changes.

    `curve_of` returns of the form's numbers the curve, and the times at which that jumps.
    """

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        return [_changed(view, *curve_of(p))]

    def about_another(view: View, p: Sequence[float]) -> list[FloatArray]:
        return [*columns(view, p), _response(view, unit_step(0.0), *curve_of(p))]

    def sizes(p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        return {**form.sizes(p, c, g), "about_output": dataset.output0 - c[1] / (c[0] or math.inf)}

    words = f"{form.form} about another output".strip()
    other = replace(form, form=words, columns=about_another, sizes=sizes)
    return replace(form, columns=columns, other_forms=(other,))


def _straight(dataset: Dataset) -> Effect:
    span = dataset.span_s

    def curve_of(_p: Sequence[float]) -> tuple[Curve, Sequence[float]]:
        return lambda t: t / span, ()

    straight = Effect(
        "gain_drift",
        Place.PROCESS,
        (),
        [()],
        lambda _p, c, g: {"relative_change_per_h": c[0] / g / span * 3600.0},
        group="gain in time",
    )
    return _along(curve_of, dataset, straight)


def _settling(dataset: Dataset) -> Effect:
    span = dataset.span_s

    def curve_of(p: Sequence[float]) -> tuple[Curve, Sequence[float]]:
        return lambda t: -np.expm1(-t / (math.exp(p[0]) * span)), ()

    def sizes(p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        return {"relative_change": c[0] / g, "settles_over_s": math.exp(p[0]) * span}

    settling = Effect(
        "gain_drift",
        Place.PROCESS,
        (Searched("log_settling", math.log(0.02), math.log(2.0), 1e-4),),
        [(math.log(share),) for share in SETTLING],
        sizes,
        form="settling",
        group="gain in time",
        means=lambda _p, c, g, _shape: 1.0 + c[0] / g > 0.0,
    )
    return _along(curve_of, dataset, settling)


def _free(dataset: Dataset) -> Effect:
    at = np.linspace(0.0, dataset.fitted_until_s, KNOTS)

    def hats(t: FloatArray) -> FloatArray:
        return np.array([np.interp(t, at, hat) for hat in np.eye(KNOTS)[1:]])

    return Effect(
        "gain_drift",
        Place.PROCESS,
        (),
        [()],
        lambda _p, c, g: {"relative_change": c[-1] / g, "largest_relative_change": max(c, key=abs) / g},
        form=f"free, {KNOTS} knots",
        columns=lambda view, _p: list(_changed(view, hats)),
        price=2.0,
        group="gain in time",
        means=lambda _p, c, g, _shape: all(1.0 + x / g > 0.0 for x in c),
    )


def _jump(dataset: Dataset) -> Effect:
    span = dataset.span_s
    moment, starts = moment_of(dataset, MOMENTS)

    def curve_of(p: Sequence[float]) -> tuple[Curve, Sequence[float]]:
        at_s = p[0] * span
        return lambda t: (t > at_s).astype(np.float64), (at_s,)

    jump = Effect(
        "gain_drift",
        Place.PROCESS,
        (moment,),
        [(s,) for s in starts],
        lambda p, c, g: {"relative_change": c[0] / g, "at_s": p[0] * span},
        form="jump",
        price=math.log(12.0),
        group="gain in time",
        means=lambda p, c, g, _shape: 1.0 + c[0] / g > 0.0 and by_chance(dataset, p[0] * span),
    )
    return _along(curve_of, dataset, jump)
