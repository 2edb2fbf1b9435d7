"""Losses that do not grow in proportion to the PV.

    w = G[v - (h(w) - w)],   h(w) = L ((1 + w/L)^p - 1)/p = w + b w^2 + ...,   L = (p - 1)/(2 b)

with `w` the response of the process of unit gain as deviation from rest, `v` its input, `L` the level, or temperature,
above that at which the loss ends, over the gain: p = 1/2 free outflow (Torricelli), 4 radiation (Stefan, Boltzmann),
2 any other loss to second order (free convection, p = 1.25 to 1.33). Evaporation grows like the pressure of the vapour,
by a factor for every degree (Clausius, Clapeyron), which is the limit of large p:  h(w) = (e^{2 b w} - 1)/(2 b).

    w = G[v + s (e^{c w} - 1 - c w)/c]

has a reaction that heats, and runs faster by a factor for every degree (Arrhenius; Semenov's approximation): at rest
its heat takes up the part s/(1 + s) of what the loss grows with the PV.

    w = G[v - (a w^2 + b w^3)/s]

is the free form: a loss, or a spring where the process rings, that grows more (b > 0: hardening, Duffing) or less than
the PV, and on one side more than on the other (a). `s` the square of the range of `w`. Its next term, `c w^4`, shows
what the other two leave open. Of two or three stores in a row, the last one may have a loss alone, like the lower of
two tanks.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.process.stepping import with_loss, with_loss_at_the_end
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Pair

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Curve = Callable[[FloatArray], FloatArray]

FORMS = {"": 2.0, "outflow": 0.5, "radiation": 4.0}
AT_THE_END = ("outflow", "radiation")
"""Losses by one number that the last of two stores may have alone."""
EXPONENTIAL, LARGEST_EXPONENT = "exponential", 30.0
"""Form that is tried in place of another one, and exponent beyond which no store of a record is."""
POWERS = {**FORMS, EXPONENTIAL: math.inf}
"""Power of each loss by one number."""
REACTION, MOST_HEAT = "reaction", 5.0
"""Form with the heat of a reaction, and how much more of it a degree makes at most, over what is left of the loss: five
sixths of the loss. With all of it, the process runs away."""
HEATED = ((0.5, 0.2), (-0.5, 0.2))
"""Exponent over the swing, either way, and heat to begin from."""
LAST_ALONE = "of the last store"
"""What the form of such a loss is called."""
LOSS = "loss"
"""Name of the one number of a loss."""
STARTS, TRIED = (-0.5, -0.2, 0.2, 0.5, 1.0), (-0.2, 0.5)
"""Numbers of a loss to begin from, over the swing: in a search, and in place of another loss."""
RINGS = 2.0
"""`n^2/m` under which a pair of poles rings: a damping ratio of 0.7."""
SLOW_LAST, WHICH = Searched("slow_last", 0.0, 1.0, 0.0), (0.0, 1.0)
"""Which of the stores is the last one, the quickest or the slowest: either is where a search begins, no slope."""
EMPTY = 0.02
"""Least level, over that at rest."""
SMALLEST = 1e-9
"""Curvature over the swing under which the loss is a straight line to the rounding of a double."""


def losses(dataset: Dataset, base: Fitted) -> tuple[Effect, ...]:
    """Return the loss in each form; of a process that rings, a spring takes the place of the free one."""
    motion = base.problem.structure.motion(base.problem.split(base.theta)[0], dataset.span_s)
    rings = isinstance(motion, Pair) and motion.n**2 < RINGS * motion.m
    free = _cubic(dataset, base)
    free = replace(free, name="nonlinear_stiffness") if rings else free
    everywhere = _or_by_another_law([*(_loss(dataset, form) for form in FORMS), free], *_exponentials(dataset))
    if rings:
        return everywhere
    alone = [_cubic(dataset, base, last=True), *(_loss(dataset, form, last=True) for form in AT_THE_END)]
    return (*everywhere, *_or_by_another_law(alone, *_exponentials(dataset, last=True)))


def _exponentials(dataset: Dataset, *, last: bool = False) -> tuple[Effect, Effect]:
    """Return the loss and the heat that grow exponentially, as they are tried where another one was found."""
    return _with_few_starts(_loss(dataset, EXPONENTIAL, last=last)), _reaction(dataset, last=last)


def _or_by_another_law(known: Sequence[Effect], *others: Effect) -> tuple[Effect, ...]:
    """Return the losses at one place, in whose place those of one number and some others are tried."""
    of_one_number = [law for law in known if law.searched[-1].name == LOSS]
    laws = [*map(_with_few_starts, of_one_number), *others]
    return tuple(replace(loss, other_forms=tuple(law for law in laws if law.form != loss.form)) for loss in known)


def _with_few_starts(law: Effect) -> Effect:
    """Return a loss as it is tried where another one was found."""
    return replace(law, starts=[start for start in law.starts if start[-1] in TRIED])


def _cubic(dataset: Dataset, base: Fitted, *, last: bool = False) -> Effect:
    """Return a loss or a spring with a square and a cubic part; numbers are shares of the linear one at half range.

    With `last` it is that of the last of two stores in a row alone.
    """
    half = float(np.ptp(dataset.data.pv[dataset.fitted])) / 2.0 / (abs(float(base.linear[0])) or 1.0)  # output units
    slow = (SLOW_LAST,) if last else ()
    of_last = [(which, b, a) for which in WHICH for b, a in ((0.2, 0.0), (1.0, 0.0), (0.1, 0.4), (0.1, -0.4))]

    def response(view: View, p: Sequence[float]) -> FloatArray:
        b, a, *fourth = p[len(slow) :]
        return _answer(view, _power_law(a / half, b / half**2, sum(fourth) / half**3), p[: len(slow)])

    def sizes(p: Sequence[float], _c: Sequence[float], g: float) -> Mapping[str, float]:
        b, a = p[len(slow) : len(slow) + 2]
        return {"cubic_per_pv2": b / (half * g) ** 2, "square_per_pv": a / (half * g)}

    cubic = Effect(
        "nonlinear_loss",
        Place.PROCESS,
        (*slow, Searched("cubic", -0.3, 30.0, 1e-4), Searched("square", -3.0, 3.0, 1e-4)),
        of_last if last else [(b, 0.0) for b in (0.03, 0.2, 0.8, 3.0)],
        sizes,
        form=LAST_ALONE if last else "cubic",
        response=response,
        price=3.0 if last else 2.0,
        group="loss",
        takes_third=last,
    )
    fourth = replace(cubic, searched=(*cubic.searched, Searched("fourth", -30.0, 30.0, 1e-4)))
    return replace(cubic, next_terms=(fourth,))


def _answer(view: View, law: tuple[Curve, Curve], slow_last: Sequence[float]) -> FloatArray:
    """Return the response with a loss: of the last store alone where `slow_last` has which one that is."""
    return with_loss_at_the_end(view, *law, slow_last=slow_last[0] > 0.5) if slow_last else with_loss(view, *law)


def _power_law(a: float, b: float, c: float) -> tuple[Curve, Curve]:
    """Return `-(a w^2 + b w^3 + c w^4)` and its slope."""
    return (
        lambda w: -(a + (b + c * w) * w) * w * w,
        lambda w: -(2.0 * a + (3.0 * b + 4.0 * c * w) * w) * w,
    )


def _loss(dataset: Dataset, form: str, *, last: bool = False) -> Effect:
    """Return a loss by one number; with `last` that of the last of two stores in a row alone."""
    swing, power = dataset.swing, POWERS[form]
    starts = [(start,) for start in STARTS]

    def response(view: View, p: Sequence[float]) -> FloatArray:
        b = p[-1] / swing
        if abs(b) < SMALLEST / swing:
            return view.forced(view.input)
        return _answer(view, excess(b, power), p[:-1])

    return Effect(
        "nonlinear_loss",
        Place.PROCESS,
        (*((SLOW_LAST,) if last else ()), Searched(LOSS, -3.0, 3.0, 1e-4)),
        [(which, *start) for which in WHICH for start in starts] if last else starts,
        lambda p, _c, g: {"loss_per_pv": p[-1] / (swing * g)},
        form=f"{form} {LAST_ALONE}" if last else form,
        response=response,
        price=1.0 if last else 0.0,
        group="loss",
        takes_third=last,
    )


def _reaction(dataset: Dataset, *, last: bool = False) -> Effect:
    """Return a loss less the heat of a reaction; with `last` that of the last of two stores in a row alone."""
    swing = dataset.swing

    def response(view: View, p: Sequence[float]) -> FloatArray:
        c, heat = p[-2] / swing, p[-1]
        if abs(c) < SMALLEST / swing:
            return view.forced(view.input)
        added, slope = _exponential_excess(c)
        return _answer(view, (lambda w: -heat * added(w), lambda w: -heat * slope(w)), p[:-2])

    return Effect(
        "nonlinear_loss",
        Place.PROCESS,
        (
            *((SLOW_LAST,) if last else ()),
            Searched("growth", -3.0, 3.0, 1e-4),
            Searched("heat", 0.0, MOST_HEAT, 1e-4),
        ),
        [(which, *start) for which in WHICH for start in HEATED] if last else HEATED,
        lambda p, _c, g: {"heat_share": p[-1] / (1.0 + p[-1]), "growth_per_pv": p[-2] / (swing * g)},
        form=f"{REACTION} {LAST_ALONE}" if last else REACTION,
        response=response,
        price=2.0 if last else 1.0,
        group="loss",
        takes_third=last,
        means=lambda p, _c, g, _o: p[-2] * g > 0.0,
    )


def excess(b: float, power: float) -> tuple[Curve, Curve]:
    """Return `w - h(w)`, which is added to the input, and its slope; that of an infinite power is exponential."""
    if math.isinf(power):
        return _exponential_excess(2.0 * b)
    level = (power - 1.0) / (2.0 * b)

    def filled(w: FloatArray) -> FloatArray:
        result: FloatArray = np.maximum(1.0 + w / level, EMPTY)
        return result

    def added(w: FloatArray) -> FloatArray:
        result: FloatArray = w - level * (filled(w) ** power - 1.0) / power
        return result

    def slope(w: FloatArray) -> FloatArray:
        result: FloatArray = 1.0 - filled(w) ** (power - 1.0)
        return result

    return added, slope


def _exponential_excess(b: float) -> tuple[Curve, Curve]:
    """Return `w - (e^{b w} - 1)/b` and its slope."""

    def exponent(w: FloatArray) -> FloatArray:
        result: FloatArray = np.minimum(b * w, LARGEST_EXPONENT)
        return result

    return lambda w: w - np.expm1(exponent(w)) / b, lambda w: -np.expm1(exponent(w))
