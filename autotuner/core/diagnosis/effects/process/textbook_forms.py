"""Effects of the process itself.

With `w` the response of the process of unit gain to the input `v`, both as deviations from rest:

    state_saturation    w stops at a limit, and leaves it as soon as the input falls
    direction_dynamics  w = G[v + (r - 1) max(v - w, 0)]    rises r times as fast as it falls
                        tau x' = u - x,  tau by its sign    an actuator with a lag for each direction
    slow_mode           + c v/(Ts s + 1)                    a slow second mode
                        + c1 v/(Ts s + 1) + c2 v/(q Ts s + 1)   heat that spreads: many modes, for which two stand
    extra_lag           G(s)/(Tx s + 1)
                        G(s)/((1 + e) Tx s + 1)/((1 - e) Tx s + 1)      a row of lags; by partial fractions
    inverse_response    + c dw/dt
                        + c v/(Tq s + 1),  c of the other sign, Tq short     a second, quicker way that acts against it
    not_settled         + the motion from an initial state

(the last from any textbook on linear systems; the first as in Morari and Zafiriou, Robust Process Control, 1989.)
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.declared import lagged
from autotuner.core.diagnosis.effects.process.gain_in_time import gains_in_time
from autotuner.core.diagnosis.effects.process.nonlinear_losses import losses
from autotuner.core.diagnosis.effects.process.recycle import recycle
from autotuner.core.diagnosis.effects.process.state_limits import overflowing_stores
from autotuner.core.diagnosis.effects.process.stepping import stepped, two_speeds
from autotuner.core.diagnosis.extended.effect import ONE_LAG, TWO_LAGS, Effect, Place, Searched, View
from autotuner.core.model.step_responses import Lag, Pair, PairAndLag
from autotuner.core.model.zoh_input import unit_step

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

BELOW, NEAR_THE_END = (0.3, 0.45, 0.6, 0.75), (0.995, 0.97, 0.9)
"""Initial guesses of limits: below the highest output, in swings, and at quantiles of the response."""
UNLIKE = 0.15
"""Difference of each of two further lags from their mean, as a share of it: equal ones have no partial fractions, and
of unlike ones a record shows little more than the mean."""
THIRD = (0.1, 0.35)
"""Third lag to start from, over the sum of the two."""
MOST_AGAINST = 0.6
"""Most that a second way takes back of the first one's gain: two ways that nearly cancel explain any response."""
UNEQUAL = 1.2
"""Ratio of the two lags of an element from which they differ: with equal ones, it is one lag more."""
SECOND_MODE = 0.2
"""Time constant of the second of two modes over that of the first."""


def process_effects(dataset: Dataset, base: Fitted) -> tuple[Effect, ...]:
    """Return the effects, with starts from the swing, the length of the record, and the process alone."""
    return (
        *losses(dataset, base),
        *_overflows(dataset, float(base.linear[0])),
        *(() if dataset.tuned or dataset.controller is not None else (overflowing_stores(dataset),)),
        _direction_dynamics(),
        _unequal_lags(dataset),
        *_slow_mode(dataset),
        *recycle(dataset),
        *_in_place_of_each_other(_inverse_response(), _second_way(dataset)),
        *gains_in_time(dataset),
        _not_settled(),
    )


def _overflows(dataset: Dataset, gain: float) -> tuple[Effect, ...]:
    levels = dataset.data.held.levels
    swing = dataset.swing
    reached = _reached(dataset, gain)

    def limited(sign: float, name: str) -> Effect:
        extreme = float((sign * levels).max())
        shares = [s for s in (*BELOW, *((extreme - sign * w) / swing for w in reached[sign])) if 0.0 < s < 1.0]

        def response(view: View, p: Sequence[float]) -> FloatArray:
            limit = extreme - p[0] * swing
            return stepped(view, None, (-math.inf, limit) if sign > 0.0 else (-limit, math.inf))

        def sizes(p: Sequence[float], _c: Sequence[float], g: float) -> Mapping[str, float]:
            return {"limit_above_rest": sign * g * (extreme - p[0] * swing)}

        return Effect(
            "state_saturation",
            Place.PROCESS,
            (Searched("below_extreme", 0.0, 1.0, 1e-4),),
            [(share,) for share in shares],
            sizes,
            form=name,
            response=response,
        )

    def spilling() -> Effect:
        extreme = float(levels.max())

        def response(view: View, p: Sequence[float]) -> FloatArray:
            edge, strength = extreme - p[0] * swing, math.exp(p[1])
            return stepped(view, lambda _v, w: -strength * max(w - edge, 0.0))

        return Effect(
            "state_saturation",
            Place.PROCESS,
            (Searched("below_extreme", 0.0, 1.0, 1e-4), Searched("log_strength", -2.0, 3.0, 1e-3)),
            [(share, 0.0) for share in (*BELOW, *((extreme - w) / swing for w in reached[1.0])) if 0.0 < share < 1.0],
            lambda p, _c, g: {"limit_above_rest": g * (extreme - p[0] * swing), "strength": math.exp(p[1])},
            form="spills",
            response=response,
            price=2.0,
        )

    return limited(1.0, "high"), limited(-1.0, "low"), spilling()


def _reached(dataset: Dataset, gain: float) -> dict[float, list[float]]:
    """Return how far the PV comes on either side, over the gain: where it rests at a limit, that is the limit."""
    w = (dataset.data.pv[dataset.fitted] - np.mean(dataset.data.pv[: max(dataset.at_rest, 1)])) / (gain or math.inf)
    return {sign: np.quantile(w, [0.5 + sign * (q - 0.5) for q in NEAR_THE_END]).tolist() for sign in (1.0, -1.0)}


def _direction_dynamics() -> Effect:
    def response(view: View, p: Sequence[float]) -> FloatArray:
        return two_speeds(view, math.exp(p[0]))

    return Effect(
        "direction_dynamics",
        Place.ACTUATOR,
        (Searched("log_ratio", -1.6, 1.6, 1e-4),),
        [(-0.7,), (-0.3,), (0.3,), (0.7,)],
        lambda p, _c, _g: {"rise_over_fall": math.exp(p[0])},
        response=response,
        order=5,
    )


def _unequal_lags(dataset: Dataset) -> Effect:
    low, high = math.log(0.05 * dataset.data.interval_s), math.log(dataset.span_s / 5.0)
    some = [math.log(samples * dataset.data.interval_s) for samples in (0.5, 4.0, 15.0)]
    return Effect(
        "direction_dynamics",
        Place.ACTUATOR,
        (Searched("log_rising", low, high, 1e-3), Searched("log_falling", low, high, 1e-3)),
        [(up, down) for up in some for down in some if up != down],
        lambda p, _c, _g: {"rising_lag_s": math.exp(p[0]), "falling_lag_s": math.exp(p[1])},
        form="element",
        position=lambda held, p, _: lagged(held, math.exp(p[0]), math.exp(p[1]), finest_s=dataset.finest_s),
        order=2,
        group="timing",
        price=2.0,
        means=lambda p, _c, _g, _shape: abs(p[0] - p[1]) > math.log(UNEQUAL),
    )


def _slow_mode(dataset: Dataset) -> tuple[Effect, ...]:
    span = dataset.span_s
    searched = (Searched("log_slow", math.log(span / 100.0), math.log(10.0 * span), 1e-4),)
    starts = [(math.log(share * span),) for share in (0.05, 0.15, 0.5)]

    def soak(form: str, ratios: tuple[float, ...]) -> Effect:
        def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
            when = view.t - view.delay_s
            return [Lag(ratio * math.exp(p[0])).forced(view.input, when)[0][0] for ratio in ratios]

        def sizes(p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
            slow = sum(c)
            mean = sum(r * n for r, n in zip(ratios, c, strict=True)) / (slow or 1.0)
            return {"time_constant_s": mean * math.exp(p[0]), "share": slow / (g + slow)}

        price = 2.0 * (len(ratios) - 1)
        return Effect(
            "slow_mode",
            Place.PROCESS,
            searched,
            starts,
            sizes,
            form,
            columns=columns,
            price=price,
            group="soak",
            means=lambda p, c, g, shape: all(n * g > 0.0 for n in c) and math.exp(p[0]) > max(shape, default=0.0),
        )

    return soak("", (1.0,)), soak("spread", (1.0, SECOND_MODE))


def _in_place_of_each_other(one: Effect, other: Effect) -> tuple[Effect, Effect]:
    """Return two forms of an effect, each of which is tried where the other was found."""
    return replace(one, other_forms=(other,)), replace(other, other_forms=(one,))


def _inverse_response() -> Effect:
    def columns(view: View, _p: Sequence[float]) -> list[FloatArray]:
        motion = view.motion
        if isinstance(motion, Lag | Pair):
            return [motion.forced(view.input, view.t - view.delay_s)[1][0]]
        return [np.zeros(view.t.size)]

    return Effect(
        "inverse_response",
        Place.PROCESS,
        (),
        [()],
        lambda _p, c, g: {"Z": -c[0] / g},
        columns=columns,
        makes_late=True,
        means=lambda _p, c, g, _shape: c[0] * g < 0.0,
    )


def _second_way(dataset: Dataset) -> Effect:
    """Return a quicker way to the PV beside the first one, which acts against it: level swell, a bypass."""
    low, high = math.log(0.2 * dataset.data.interval_s), math.log(dataset.span_s / 4.0)

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        return [Lag(math.exp(p[0])).forced(view.input, view.t - view.delay_s)[0][0]]

    return Effect(
        "inverse_response",
        Place.PROCESS,
        (Searched("log_quick", low, high, 1e-4),),
        [(math.log(share * dataset.span_s),) for share in (0.005, 0.015, 0.05)],
        lambda p, c, g: {"time_constant_s": math.exp(p[0]), "share_against": -c[0] / (g + c[0])},
        form="a second way",
        columns=columns,
        price=1.0,
        makes_late=True,
        means=lambda p, c, g, shape: (
            -MOST_AGAINST * g * g < c[0] * g < 0.0 and math.exp(p[0]) < max(shape, default=math.inf)
        ),
    )


def further_lags(dataset: Dataset, base: Fitted) -> tuple[Effect, Effect]:
    """Return a lag, and two, after a pair of lags, which a free model of two lags cannot absorb."""
    shape, _, _ = base.problem.split(base.theta)
    whole_s = shape[0] if shape else dataset.span_s / 20.0
    low, high = math.log(0.2 * dataset.data.interval_s), math.log(dataset.span_s)

    def behind(view: View, lag_s: float) -> FloatArray:
        motion, when = view.motion, view.t - view.delay_s
        if isinstance(motion, Pair):
            return PairAndLag(motion.m, motion.n, lag_s).forced(view.input, when)[0][0]
        return view.forced(view.input)

    def two(view: View, p: Sequence[float]) -> FloatArray:
        slow, quick = (1.0 + UNLIKE) * math.exp(p[0]), (1.0 - UNLIKE) * math.exp(p[0])
        return (slow * behind(view, slow) - quick * behind(view, quick)) / (slow - quick)

    third = Effect(
        "extra_lag",
        Place.PROCESS,
        (Searched("log_lag", low, high, 1e-4),),
        [(min(max(math.log(share * whole_s), low), high),) for share in THIRD],
        lambda p, _c, _g: {"time_constant_s": math.exp(p[0])},
        form=ONE_LAG,
        response=lambda view, p: behind(view, math.exp(p[0])),
        makes_late=True,
    )
    both = replace(
        third, sizes=lambda p, _c, _g: {"time_constant_s": 2.0 * math.exp(p[0])}, form=TWO_LAGS, response=two
    )
    return _in_place_of_each_other(third, both)


def _not_settled() -> Effect:
    def columns(view: View, _p: Sequence[float]) -> list[FloatArray]:
        before = view.forced(unit_step(0.0))
        return [*view.motion.free(view.t), np.where(view.t >= view.delay_s, before, 0.0)]

    return Effect(
        "not_settled",
        Place.SENSOR,
        (),
        [()],
        lambda _p, c, _g: {"pv_off_at_start": c[0]},
        columns=columns,
        group="start",
        unseen_after=True,
    )
