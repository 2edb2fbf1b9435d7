"""An explanation made plain: of two that follow a record about as well, the plainer one, by the criterion.

pair of lags -> one lag      lag that outlasts the record -> integrator
form of friction with two numbers -> plain play
kink with a gain of zero on one side -> limit
drift that settles as fast as the process answers -> load step
load that ramps as long as the record shows -> straight drift
two changes at a time each, of which the later one takes the first back -> load or reading that comes and goes
two effects -> one of them in another form
load of free shape, late drift -> drift along a cubic, slow wave
curve of an actuator that stands at a few levels -> steps
form of an effect whose further numbers say nothing -> its plain form

Two are made richer: stores that overflow -> stores of any shape, whose search needs these to begin from; and a pair of
lags -> three, which is no effect, but whose absence biases the gain by many of its standard errors.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import permutations
from typing import TYPE_CHECKING

from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.effects.actuator.levels import step_grids
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation
from autotuner.core.diagnosis.effects.disturbance import curved_drift
from autotuner.core.diagnosis.effects.process.shaped_stores import shaped_stores
from autotuner.core.diagnosis.effects.process.state_limits import STORES
from autotuner.core.diagnosis.effects.waves import SLOW_WAVE
from autotuner.core.diagnosis.extended.base import INTEGRATORS, is_physical, outlasts_the_record, with_integrator
from autotuner.core.diagnosis.extended.coloured_noise import coloured_noise
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.search.acceptance import that_stick
from autotuner.core.diagnosis.search.exchange import closest_exchanged, exchanged, in_near_forms, values_of
from autotuner.core.diagnosis.search.judge import GAIN, MUCH_BETTER, is_near_noise, is_shown, weigh
from autotuner.core.diagnosis.search.neighbours import one_lag_more, with_one_lag
from autotuner.core.diagnosis.search.screen import fits_beside
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    FINE_STEPS,
    alone_beside,
    extend,
    form_of,
    has_several,
    without,
)
from autotuner.core.model.structures import SECOND_ORDER
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

MOMENT = "moment"
"""Name of the searched number that is the time of a change, as a share of the record."""
NEARBY, AWAY = (-3, -2, -1, 1, 2, 3), (-0.05, -0.03, -0.02, -0.01, -0.005, 0.005, 0.01, 0.02, 0.03, 0.05)
"""Other moments that are tried, in samples and in records away."""
BEST_MOMENTS = 3
"""Of these, the number from which a fit begins."""
POSITIVE, STRONG = 2.0, 10.0
"""Improvement required of another form with as many numbers, and of a drift shaped like the response: positive and
very strong evidence (Kass, Raftery 1995)."""
FLAT = 0.05
"""Ratio of two gains of an actuator under which the smaller one is zero."""
MUCH_LARGER = 1.4
"""Ratio of the errors on the part not fitted from which the plainer explanation fails there: twice the squares."""
RAMP = "load_step:ramp"
"""The effect that a straight drift may replace."""
CHANGES, PAIR = frozenset({"load_step", "bias_step", "drift"}), 2
"""Effects that change something at one time, and the number of them that one which comes and goes may replace."""
PULSES = frozenset({"ends again", "there and back"})
"""Forms that come and go."""
SLOW = "slow"
"""Group of the effects that follow a course of time."""
CURVES = frozenset({"static_nonlinearity", "direction_gain", "saturation"})
"""Effects that give each level of the output another one, as steps do."""
RICH = 2
"""Numbers of the forms of friction that plain play may replace."""


def simplest(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with one lag, or with an integrator, where a further number says nothing of the process.

    A lag far longer than the record is an integrator there: its gain, too, could be any.
    """
    problem = chosen.problem
    if not problem.effects or problem.fixed is not None:
        return chosen
    if problem.structure is SECOND_ORDER:
        chosen = _plainer(context, chosen, with_one_lag(chosen))
    return _integrating(context, chosen)


def _integrating(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with an integrator in place of a lag that outlasts the record, where that is as good.

    An effect that changes the response of the process (a loss, a recycle) is one of its lags, and keeps them.
    """
    problem = chosen.problem
    settles = problem.structure in INTEGRATORS and not any(e.response is not None for e in problem.effects)
    if not settles or not outlasts_the_record(chosen):
        return chosen
    return _plainer(context, chosen, with_integrator(chosen, FINE_STEPS))


def with_third_lag(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with a third lag of the process where both parts speak for it.

    Noise hides one, and so may an effect that leaves more than noise. Noise with a memory hides more of it: there, the
    lag is real where the residual is such noise with it only; without it, the innovations follow the output.
    """
    if chosen.problem.structure is not SECOND_ORDER:
        return chosen
    is_noise = is_near_noise(context, chosen)
    if is_noise or chosen.problem.effects:
        return _with_one_lag_more(context, chosen, 0.0 if is_noise else GAIN)
    richer = None if coloured_noise(context, chosen) else one_lag_more(context, chosen)
    return richer if richer is not None and coloured_noise(context, richer) else chosen


def with_third_lag_in_response(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with a third lag of the process in the response of an effect, where both parts show it.

    No further effect can be one beside such: a loss, a recycle or the play of a sensor has the response of the process.
    """
    problem = chosen.problem
    takes_one = problem.structure is SECOND_ORDER and any(e.takes_third for e in problem.effects)
    return _with_one_lag_more(context, chosen, GAIN) if takes_one else chosen


def _with_one_lag_more(context: FitContext, chosen: Fitted, least_gain: float) -> Fitted:
    richer = one_lag_more(context, chosen)
    if richer is None:
        return chosen
    evidence = weigh(context, chosen, richer)
    return richer if evidence.gain > least_gain and evidence.held_out_ratio < 1.0 else chosen


def with_plain_play(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with plain backlash where a form of friction with more parameters is not significant."""
    rich = next((e for e in chosen.problem.effects if e.group == "friction" and len(e.searched) == RICH), None)
    plain = form_of(effects, "backlash")
    if rich is None or plain is None:
        return chosen
    play = exchanged(chosen, rich, plain, [_width_of_play(rich, values_of(chosen, rich))])
    return _plainer(context, chosen, play)


def with_plain_limit(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with a limit of the actuator where its gain on one side of a kink is zero."""
    kink = next((e for e in chosen.problem.effects if e.form == "kink elsewhere"), None)
    ratio = next((abs(sizes["ratio"]) for sizes in chosen.sizes() if "kink" in sizes), 1.0)
    side = "high" if ratio < FLAT else "low"
    limit = form_of(effects, "saturation", side)
    if kink is None or limit is None or FLAT <= ratio <= 1.0 / FLAT:
        return chosen
    (at,) = values_of(chosen, kink)
    return _plainer(context, chosen, exchanged(chosen, kink, limit, [1.0 - at if side == "high" else at]))


@lru_cache(maxsize=4)
def with_other_forms(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with each effect in another form where both parts together speak for it. Cached."""
    for effect in chosen.problem.effects:
        others = in_near_forms(context, chosen, effect)
        chosen = _likeliest(context, chosen, others) if others else chosen
    return chosen


def _likeliest(context: FitContext, chosen: Fitted, others: Sequence[Fitted]) -> Fitted:
    """Return the form that both parts together speak for, the chosen one unless another one is clearly likelier.

    The criterion is of the fitted part; what follows was predicted, and counts as it is.
    """
    inflated = context.colour(chosen)
    later = {form: context.held_out_residual(form) for form in (chosen, *others)}
    independent = context.held_out.size / min(map(context.inflation, later.values()))
    unlikely = {
        form: context.criterion(form, inflated) + independent * math.log(rms(left) ** 2 + context.dataset.floor**2)
        for form, left in later.items()
    }
    best = min(others, key=unlikely.__getitem__)
    more = 0.0 if best.size < chosen.size else -POSITIVE
    return best if unlikely[best] <= unlikely[chosen] + more else chosen


def with_plain_forms(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with the plain form of an effect where the further numbers of its form say nothing."""
    for rich in [e for e in chosen.problem.effects if e.form]:
        known = dict(zip([s.name for s in rich.searched], values_of(chosen, rich), strict=True))
        plains = {"", rich.form.partition(",")[0]} - {rich.form}  # a soft limit is a hard one with a width, too
        plain = next((e for e in effects if e.name == rich.name and e.form in plains), None)
        if plain is not None and all(s.name in known for s in plain.searched):
            values = [known[s.name] for s in plain.searched]
            # One lag may be enough only beside the plain form: the rich one has taken up what the second one left.
            chosen = _plainer(context, chosen, simplest(context, exchanged(chosen, rich, plain, values)))
    return chosen


def with_plain_step(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with a load in place of a drift that settles as fast as the process answers."""
    settling = form_of(chosen.problem.effects, "drift", "settling")
    step = form_of(effects, "load_step")
    if (
        settling is None
        or step is None
        or not fits_beside(step, [e for e in chosen.problem.effects if e is not settling])
    ):
        return chosen
    _, delay_s, _ = chosen.problem.split(chosen.theta)
    start = values_of(chosen, settling)[1]
    moments = [min(max(start + by * delay_s / context.dataset.span_s, 0.01), 0.99) for by in (0.0, -0.5, 0.5)]
    plain = [exchanged(chosen, settling, step, [moment]) for moment in moments]
    # Elsewhere a drift is as likely as a load, and few samples are independent.
    return _plainer(context, chosen, closest_first(plain)[0], STRONG if context.dataset.tuned else 0.0)


def with_plain_drift(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with a straight drift in place of a load whose ramp begins and ends where none shows."""
    ramp = next((e for e in chosen.problem.effects if e.key == RAMP), None)
    drift = form_of(effects, "drift")
    others = [e for e in chosen.problem.effects if e is not ramp]
    if ramp is None or drift is None or not fits_beside(drift, others):
        return chosen
    return _plainer(context, chosen, exchanged(chosen, ramp, drift, []))


def with_one_form(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with one effect less where another one in another form does as much.

    From the process alone the search may not find that form, and mend the wrong one with a further effect. Friction
    stays where the valve is seen to stick.
    """
    if not has_several(context, chosen):
        return chosen
    tried = []
    seen = SLIPS if that_stick(context, [chosen]) else frozenset()
    for kept, dropped in permutations(chosen.problem.effects, 2):
        if dropped.name in seen:
            continue
        forms = [e for e in effects if e.name == kept.name and e.form != kept.form]
        beside = [e for e in chosen.problem.effects if e not in {kept, dropped}]
        if forms and not context.dataset.budget.spent:
            tried += extend(context, [alone_beside(context, chosen, *beside)], forms)
    near = context.by_criterion((c for c in tried if c.rms < AS_NEAR * chosen.rms), context.colour(chosen))
    return _plainer(context, chosen, near[0]) if near else chosen


def with_one_pulse(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with a load, or an error of the reading, that comes and goes in place of two changes."""
    timed = [
        (e, sizes.get("at_s", sizes.get("from_s")))
        for e, sizes in zip(chosen.problem.effects, chosen.sizes(), strict=True)
        if e.name in CHANGES and e.form not in PULSES
    ]
    known = sorted(((at_s, e) for e, at_s in timed if at_s is not None), key=lambda change: change[0])
    if len(known) != PAIR or context.dataset.budget.spent:
        return chosen
    (begins_s, first), (ends_s, second) = known
    begins, lasts = begins_s / context.dataset.span_s, (ends_s - begins_s) / context.dataset.span_s
    others = [e for e in chosen.problem.effects if e not in {first, second}]
    one = without(context, chosen, second)
    tried = [
        exchanged(one, first, pulse, (begins, lasts))
        for pulse in effects
        if pulse.form in PULSES and fits_beside(pulse, others)
    ]
    return _plainer(context, chosen, closest_first(tried)[0]) if tried else chosen


def with_smooth_course(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the explanation with a drift along a cubic, or a slow wave, in place of a load or drift of another form.

    Both go on after the fitted part, which a load of free shape does not, and bend, which a late drift does not.
    """
    slow = next((e for e in chosen.problem.effects if e.group == SLOW and e.form), None)
    if slow is None or context.dataset.budget.spent:
        return chosen
    others = [e for e in chosen.problem.effects if e is not slow]
    courses = [curved_drift(context.dataset), *(e for e in effects if e.form == SLOW_WAVE)]
    tried = [
        exchanged(chosen, slow, course, start)
        for course in courses
        if course.key != slow.key and fits_beside(course, others)
        for start in course.starts
    ]
    plainer = (_plainer(context, chosen, candidate) for candidate in closest_first(tried))
    return next((candidate for candidate in plainer if candidate is not chosen), chosen)


def with_steps(context: FitContext, chosen: Fitted) -> tuple[Fitted, list[Fitted]]:
    """Return the explanation with steps of the actuator in place of a curve, and what was tried.

    Where the output stands at a few levels, both do the same to it.
    """
    curve = next((e for e in chosen.problem.effects if e.name in CURVES), None)
    if curve is None or context.dataset.tuned or context.dataset.budget.spent:
        return chosen, []
    straight = alone_beside(context, chosen, *(e for e in chosen.problem.effects if e is not curve))
    grids = step_grids(straight, context.coarse)
    steps = [(quantisation(context.dataset, form, starts), start) for form, starts in grids.items() for start in starts]
    tried = [exchanged(chosen, curve, e, start) for e, start in steps]
    if not tried:
        return chosen, []
    return _plainer(context, chosen, closest_first(tried)[0]), [c for c in tried if is_physical(c)]


def with_own_shapes(context: FitContext, chosen: Fitted) -> Fitted:
    """Return stores that overflow with an outflow of its own for each, where both parts speak for it."""
    curved = next((e for e in chosen.problem.effects if e.form == STORES), None)
    if curved is None or context.dataset.budget.spent:
        return chosen
    shaped = shaped_stores(context.dataset, values_of(chosen, curved))
    richer = closest_exchanged(context, chosen, curved, ((shaped, start) for start in shaped.starts), FINE_STEPS)
    if richer is None:
        return chosen
    evidence = weigh(context, chosen, richer)
    return richer if is_physical(richer) and evidence.gain > GAIN and evidence.held_out_ratio < MUCH_BETTER else chosen


def with_best_moment(context: FitContext, chosen: Fitted) -> Fitted:
    """Return the explanation with a change at the best of the moments nearby: a move of the output parts two minima."""
    timed = next((e for e in chosen.problem.effects if MOMENT in {s.name for s in e.searched}), None)
    if timed is None or context.dataset.budget.spent:
        return chosen
    sample = context.dataset.data.interval_s / context.dataset.span_s
    values, at = list(values_of(chosen, timed)), [s.name for s in timed.searched].index(MOMENT)
    moved = [[*values[:at], values[at] + by, *values[at + 1 :]] for by in (*(k * sample for k in NEARBY), *AWAY)]
    tried = closest_first(exchanged(chosen, timed, timed, there, 0) for there in moved)[:BEST_MOMENTS]
    refitted = [fit(c.problem, c.theta, FINE_STEPS) for c in tried]
    closest = closest_first([chosen, *(c for c in refitted if is_physical(c))])[0]
    return closest if is_shown(chosen.misfit, closest.misfit) else chosen


def _plainer(context: FitContext, chosen: Fitted, plainer: Fitted, more: float = 0.0) -> Fitted:
    """Return the plainer explanation unless the criterion (by `more`), the other part or physics speaks against it."""
    inflated = context.colour(chosen)
    good = is_physical(plainer) and context.criterion(plainer, inflated) <= context.criterion(chosen, inflated) + more
    left = math.hypot(context.held_out_error(chosen), context.dataset.floor)
    return plainer if good and context.held_out_error(plainer) < MUCH_LARGER * left else chosen


def _width_of_play(friction: Effect, values: Sequence[float]) -> float:
    """Return the play nearest to a form of friction, in swings."""
    if friction.name != "stiction":
        return values[0]
    return values[0] * ((1.0 - values[1]) if friction.form == "slipping" else 2.0 * values[1])
