"""Effects that only a declared model can lack, because a free one takes them up.

extra_lag    G(s)/(Tx s + 1)
integrating  K/s in place of a lag
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effect import Effect, Place, Searched, View
from autotuner.core.identification.held_input import HeldInput
from autotuner.core.identification.motions import Integrator, Lag, LaggedIntegrator, Pair

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.case import Case
    from autotuner.core.process import ProcessModel

PIECES = 25
"""Steps in which the approach to a new level is written."""
SETTLED = 7.0
"""Time constants after which it has arrived."""


def declared_effects(case: Case, model: ProcessModel) -> tuple[Effect, ...]:
    """Return what a declared model can lack in its dynamics."""
    slowest = model.rational().a[1] if model.rational().a[0] != 0.0 else case.span_s / 20.0
    integrates = model.rational().a[0] == 0.0
    return (_extra_lag(case, slowest), *(() if integrates else (_integrating(),)))


def _extra_lag(case: Case, slowest_s: float) -> Effect:
    low, high = math.log(0.2 * case.data.interval_s), math.log(3.0 * case.span_s)
    starts = [(math.log(share * slowest_s),) for share in (0.03, 0.1, 0.3, 1.0)]

    def response(view: View, p: Sequence[float]) -> FloatArray:
        extra = math.exp(p[0])
        if isinstance(view.motion, Lag):
            T = view.motion.T
            pair = Pair(T * extra, T + extra)
            return pair.forced(view.position, view.t - view.delay_s)[0][0]
        return view.forced(lagged(view.position, extra))

    return Effect(
        "extra_lag",
        Place.PROCESS,
        (Searched("log_lag", low, high, 1e-4),),
        starts,
        lambda p, _c, _g: {"time_constant_s": math.exp(p[0])},
        response=response,
        order=5,
    )


def lagged(held: HeldInput, T: float) -> HeldInput:
    """Return an input behind a lag, its exponentials written as small steps about their middle."""
    shares = (np.arange(PIECES) + 0.5) / PIECES
    after = -T * np.log1p(-shares * (1.0 - math.exp(-SETTLED)))
    times, levels = [held.times[:1]], [np.zeros(1)]
    x, ends = 0.0, np.append(held.times[1:], np.inf)
    for start, level, end in zip(held.times.tolist(), held.levels.tolist(), ends.tolist(), strict=True):
        way = level - x
        if way == 0.0:
            continue
        kept = after < end - start
        times.append(start + after[kept])
        levels.append(x + way * (shares[kept] + 0.5 / PIECES))
        x += way * -math.expm1(-min((end - start) / T, 50.0))
    return HeldInput(np.concatenate(times), np.concatenate(levels))


def _integrating() -> Effect:
    def response(view: View, _p: Sequence[float]) -> FloatArray:
        motion = view.motion
        integrator = LaggedIntegrator(motion.m / motion.n) if isinstance(motion, Pair) else Integrator()
        return integrator.forced(view.position, view.t - view.delay_s)[0][0]

    return Effect(
        "integrating",
        Place.PROCESS,
        (),
        [()],
        lambda _p, _c, g: {"gain_per_s": g},
        response=response,
        order=5,
    )
