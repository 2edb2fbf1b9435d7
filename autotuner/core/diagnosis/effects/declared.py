"""Effects that only a declared model can lack, because a free one takes them up.

extra_lag    G(s)/(Tx s + 1);   G(s) e^{-Dx s}/(Tx s + 1)^2 for a row of small lags
integrating  K/s in place of a lag;   K/(s + 1/Tl), which leaks with a time constant far above the declared lag
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Integrator, Lag, LaggedIntegrator, Pair
from autotuner.core.model.zoh_input import HeldInput, numbered

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

PIECES = 50
"""Steps in which the approach to a new level is written: a response to them is 2e-4 off."""
NO_WAY = 1e-9
"""Half of the share of a way that is too small to be gone: a hold may be as short as the rounding of its times."""
FAR_SLOWER = 4.0
"""Time constant of a leak over the declared lag from which a process is taken to integrate."""


def declared_effects(dataset: Dataset, model: ProcessModel) -> tuple[Effect, ...]:
    """Return the dynamic effects that a declared model can lack."""
    slowest = model.rational().a[1] if model.rational().a[0] != 0.0 else dataset.span_s / 20.0
    integrates = model.rational().a[0] == 0.0
    return (*_extra_lag(dataset, slowest), *(() if integrates else (_integrating(), _leaking(dataset, slowest))))


def _extra_lag(dataset: Dataset, slowest_s: float) -> tuple[Effect, ...]:
    low, high = math.log(0.2 * dataset.data.interval_s), math.log(3.0 * dataset.span_s)
    lag = Searched("log_lag", low, high, 1e-4)
    later = Searched("later", 0.0, 3.0 * slowest_s / dataset.data.interval_s, 1e-3)  # in sample intervals

    def response(view: View, p: Sequence[float]) -> FloatArray:
        extra = math.exp(p[0])
        when = view.t - view.delay_s - (p[1] * dataset.data.interval_s if len(p) > 1 else 0.0)
        held = lagged(view.input, extra, finest_s=dataset.finest_s) if len(p) > 1 else view.input
        if isinstance(view.motion, Lag):
            T = view.motion.T
            return Pair(T * extra, T + extra).forced(held, when)[0][0]
        answer: FloatArray = view.motion.forced(lagged(held, extra, finest_s=dataset.finest_s), when)[0][0]
        return answer

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> dict[str, float]:
        return {
            "time_constant_s": 2.0 * math.exp(p[0]) + p[1] * dataset.data.interval_s if len(p) > 1 else math.exp(p[0])
        }

    one = [(math.log(share * slowest_s),) for share in (0.03, 0.1, 0.3, 1.0)]
    row = [(*start, 0.2 * math.exp(start[0]) / dataset.data.interval_s) for start in one]
    return (
        Effect("extra_lag", Place.PROCESS, (lag,), one, sizes, response=response),
        Effect("extra_lag", Place.PROCESS, (lag, later), row, sizes, "spread", response=response, price=2.0),
    )


def lagged(held: HeldInput, rising_s: float, falling_s: float | None = None, *, finest_s: float = 0.0) -> HeldInput:
    """Return an input after a lag, its exponentials written as small steps, each at the mean time of its way.

    A share `s` of the way takes `-ln(1 - s)` time constants; the integral of that is `(1 - s) ln(1 - s) + s`. Step `k`
    of `m` ends at `1 - (1 - k/m)^2`: the later, the smaller, so that all are as exact. Of a hold that is shorter, steps
    of `finest_s` are enough.
    """
    approaches = []  # of each: begin, position there, way, time constant, where in the row of steps it ends, its steps
    x = 0.0
    for start, end, level in held.holds():
        way = level - x
        T = rising_s if way > 0.0 or falling_s is None else falling_s
        ends = -math.expm1((start - end) / T / 2.0)
        if way == 0.0 or ends < NO_WAY:
            continue
        most = math.ceil((end - start) / finest_s) if finest_s and math.isfinite(end) else PIECES
        approaches.append((start, x, way, T, ends, max(min(math.ceil(PIECES * ends), most), 1)))
        x += way * -math.expm1((start - end) / T)
    counts = np.array([of[-1] for of in approaches], dtype=int)
    starts, positions, ways, lags, ends_at, pieces = np.repeat(np.array(approaches).reshape(-1, 6), counts, axis=0).T
    step = numbered(counts)
    before, after = (1.0 - (1.0 - ends_at * k / pieces) ** 2 for k in (step, step + 1))
    from_s, to_s = (scipy.special.xlogy(1.0 - s, 1.0 - s) + s for s in (before, after))
    times = starts + lags * (to_s - from_s) / (after - before)
    return HeldInput(np.append(held.times[0], times), np.append(0.0, positions + ways * after))


def _integrating() -> Effect:
    def response(view: View, _p: Sequence[float]) -> FloatArray:
        motion = view.motion
        integrator = LaggedIntegrator(motion.m / motion.n) if isinstance(motion, Pair) else Integrator()
        return integrator.forced(view.input, view.t - view.delay_s)[0][0]

    return Effect(
        "integrating",
        Place.PROCESS,
        (),
        [()],
        lambda _p, _c, g: {"gain_per_s": g},
        response=response,
    )


def _leaking(dataset: Dataset, slowest_s: float) -> Effect:
    low, high = math.log(FAR_SLOWER * slowest_s), math.log(max(100.0 * dataset.span_s, 1000.0 * slowest_s))

    def response(view: View, p: Sequence[float]) -> FloatArray:
        leak, motion = math.exp(p[0]), view.motion
        if isinstance(motion, Pair):
            fast = motion.m / motion.n
            return Pair(leak * fast, leak + fast).forced(view.input, view.t - view.delay_s)[0][0]
        return Lag(leak).forced(view.input, view.t - view.delay_s)[0][0]

    return Effect(
        "integrating",
        Place.PROCESS,
        (Searched("log_leak", low, high, 1e-4),),
        [(math.log(times * slowest_s),) for times in (8.0, 25.0)],
        lambda p, _c, g: {"gain_per_s": g / math.exp(p[0]), "leak_s": math.exp(p[0])},
        form="leaking",
        response=response,
    )
