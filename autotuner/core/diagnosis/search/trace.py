"""Search trace: from the process alone to the accepted effects.

Effects are searched one after the other, with the best few explanations carried on (beam search), so that two effects
that only work together are found; in the end each one must be needed with the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.effects.actuator.saturation import soft_limits
from autotuner.core.diagnosis.effects.actuator.static_curve import static_curves
from autotuner.core.diagnosis.effects.jumps import plain_jump
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.coloured_noise import is_noise_instead
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.diagnosis.search.acceptance import (
    dropped_back,
    is_accepted,
    is_free_load,
    is_near_later,
    is_noise,
    leaves_white_noise,
    that_stick,
)
from autotuner.core.diagnosis.search.coincidence import LOAD, answers_a_move
from autotuner.core.diagnosis.search.exchange import with_other_starts
from autotuner.core.diagnosis.search.joint.dynamics import (
    with_curve_beside_a_load,
    with_curve_in_loop,
    with_less_dead_time,
    with_process_beside_wave,
    with_slow_output,
    with_varying_dead_time,
)
from autotuner.core.diagnosis.search.joint.friction import (
    with_friction,
    with_friction_beside_a_load,
    with_process_friction,
    with_wave,
)
from autotuner.core.diagnosis.search.joint.late_moves import late_instead, with_other_grids, with_uneven_updates
from autotuner.core.diagnosis.search.joint.positions import with_positions
from autotuner.core.diagnosis.search.joint.pulses import with_switched_output
from autotuner.core.diagnosis.search.judge import NOTHING_LEFT, is_near_noise, is_visible, noise_of
from autotuner.core.diagnosis.search.left_open import most_likely
from autotuner.core.diagnosis.search.measured_disturbances import of_columns, with_known
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    at_the_input,
    best_on_both_parts,
    better_of,
    extend,
    finished,
    form_of,
    sketched,
    within,
)
from autotuner.core.diagnosis.search.several_effects import (
    distinct,
    with_each_searched_again,
    with_exchanged_effects,
    with_exchanged_forms,
    without_disturbance,
)
from autotuner.core.diagnosis.search.simplify import (
    CURVES,
    simplest,
    with_best_moment,
    with_one_form,
    with_one_pulse,
    with_other_forms,
    with_own_shapes,
    with_plain_drift,
    with_plain_forms,
    with_plain_limit,
    with_plain_play,
    with_plain_step,
    with_smooth_course,
    with_steps,
    with_third_lag,
    with_third_lag_in_response,
)
from autotuner.core.model.arrays import SMALLEST_DIVISOR

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.search.measured_disturbances import Known
    from autotuner.core.model.process import ProcessModel

MOST_EFFECTS = 3
"""Most effects of one explanation: with more free effects the search could explain any record."""
COLOURED = 2.0
"""Samples per independent one from which a residual as small as the noise may hide a further effect."""
KNOWN = 6
"""Most explanations of a search on fewer samples that are fitted again."""
BEAM = 3
"""Explanations that are carried on to a further effect."""
TRIED, TRIED_ELSEWHERE = 4, 8
"""Number of explanations of which the best accepted one is used: on a tuning's record by the criterion, elsewhere,
with few independent samples, by both parts of the record."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Result of the search.

    Attributes
    ----------
    alone : Fitted
        The process alone: the declared model where there is one.
    chosen : Fitted
        The process with the accepted effects; the best process alone without any.
    pool : tuple of Fitted
        All fits on all samples.
    noise : float
        Noise by the closest of them, PV.
    notes : tuple of str
        Further notes for the reader.
    complete : bool
        Whether the search went to its end; False where it left the answer to more samples.
    """

    alone: Fitted
    chosen: Fitted
    pool: tuple[Fitted, ...]
    noise: float
    notes: tuple[str, ...] = ()
    complete: bool = True


def trace(
    context: FitContext,
    base: Base,
    declared: ProcessModel | None = None,
    earlier: Sequence[Fitted] = (),
    *,
    patient: bool = True,
) -> Trace:
    """Search for effects until none is accepted any more.

    `earlier` has explanations from a search on fewer samples: the same search on more may not come to them. A search
    that is not `patient` ends where an effect leaves only noise on the fitted part and fails later: more samples
    decide.
    """
    alone = base.alone
    if is_noise(context, alone):
        return Trace(alone, alone, (), noise_of(context, alone))
    known, effects, beams = _begun(context, base, declared)
    best, pool = known.best, [c for c in [known.best] if c is not base.best]
    steps: list[Fitted] = []
    beside = _fitted_again(context, earlier)
    for _ in range(MOST_EFFECTS):
        if pool and is_noise(context, best) and not is_free_load(context, best):
            break
        sketches = [sketched(context, beam, effects) for beam in beams]
        found, decided = _explanations(context, base, effects, sketches, beside, first=not steps, patient=patient)
        if not decided:
            return Trace(alone, found[0], tuple(found), noise_of(context, found[0]), complete=False)
        if not found:
            break
        pool += found
        context.dataset.budget.report(_how_far(context, found[0]))
        following, accepted = _following(context, base, best, found)
        if accepted:
            following = with_smooth_course(context, _from_its_process(context, following, declared), effects)
            following = with_third_lag_in_response(context, with_other_forms(context, following))
            following = _or_with_third_lag(context, following)
            best, effects = following, catalogue(following, context.coarse, declared)  # it leaves other traces
        steps.append(best)
        if _is_done(context, best, following, accepted=accepted) or _is_late(context, base, steps):
            break
        beside = [*with_wave(context, best), *with_less_dead_time(context, [best], effects)] if accepted else []
        jumped = _with_jump(context, base, effects) if len(steps) == 1 else []
        beams = _at_the_inputs(context, [*_carried(context, best, found, sketches), *jumped])
    best, curved = _with_free_curve(context, base, best, declared)
    best, late = with_uneven_updates(context, base, best)
    pool += curved
    chosen, tried = _with_needed_effects(context, base, best, steps, effects)
    tried += without_disturbance(context, best, chosen, pool)
    chosen, stepped = with_steps(context, chosen)
    pool += [*tried, *(stepped or _steps_instead(context, chosen, pool))]
    pool += late or late_instead(context, base, chosen)
    alone, chosen = _without_effects(context, base, alone, most_likely(chosen))
    closest = closest_first([*pool, base.best])[0]
    notes = of_columns(context, base.best, known.tried, chosen)
    return Trace(alone, chosen, tuple(pool), noise_of(context, closest), tuple(notes))


def _begun(
    context: FitContext, base: Base, declared: ProcessModel | None
) -> tuple[Known, tuple[Effect, ...], Sequence[Sequence[Fitted]]]:
    """Return the process with its measured disturbances, the effects to search for, and what they are added to."""
    effects = catalogue(base.best, context.coarse, declared, [o for o in base.origins if o is not base.best])
    known = with_known(context, base.best, effects)
    if known.best is not base.best:
        return known, catalogue(known.best, context.coarse, declared), [[known.best]]
    # Held and free explanations are ranked apart: the free one fits better, the held one means more.
    return known, effects, [base.origins] if base.held is None else [[o] for o in base.origins]


def _explanations(
    context: FitContext,
    base: Base,
    effects: Sequence[Effect],
    sketches: Sequence[Sequence[Fitted]],
    beside: Sequence[Fitted],
    *,
    first: bool,
    patient: bool,
) -> tuple[list[Fitted], bool]:
    """Return the explanations of one round, the closest first, and whether these samples decide between them.

    In the first one, effects with a process of their own are searched too, unless one of the others leaves only noise.
    A search that is not patient ends with those that leave only noise on the fitted part.
    """
    found = closest_first([*beside, *(c for sketch in sketches for c in finished(context, sketch))])
    if first and not any(_leaves_noise(context, c) for c in found):
        if not patient and (undecided := [c for c in found if _leaves_noise_on_the_fitted_part(context, c)]):
            return undecided, False
        found = closest_first([*found, *_with_processes(context, base, effects)])
    if not found:
        return [], True
    found = closest_first([*found, *with_other_grids(context, found), *with_other_starts(context, found)])
    found = closest_first([*found, *with_exchanged_effects(context, found, effects)])
    return closest_first([*found, *with_exchanged_forms(context, found, effects)]), True


def _leaves_noise(context: FitContext, candidate: Fitted) -> bool:
    """Return whether an explanation leaves white noise, and errs elsewhere by no more than its numbers may be off."""
    return _leaves_noise_on_the_fitted_part(context, candidate) and is_near_later(context, candidate)


def _leaves_noise_on_the_fitted_part(context: FitContext, candidate: Fitted) -> bool:
    """Return whether an explanation leaves white noise there; a load of free shape always may."""
    return leaves_white_noise(context, candidate) and not is_free_load(context, candidate)


def _or_with_third_lag(context: FitContext, following: Fitted) -> Fitted:
    """Return an explanation with a third lag of the process where that leaves only noise: the search ends with it."""
    if _leaves_noise(context, following):
        return following
    richer = with_third_lag(context, following)
    return richer if _leaves_noise(context, richer) else following


def _with_needed_effects(
    context: FitContext, base: Base, best: Fitted, steps: Sequence[Fitted], effects: Sequence[Effect]
) -> tuple[Fitted, list[Fitted]]:
    """Return the explanation with the effects that it needs, in their plainest forms, and others that were tried."""
    dropped = dropped_back(context, base, best)
    as_many = [step for step in steps if len(step.names) == len(dropped.names)]
    chosen = _in_plainest_form(context, better_of(context, [dropped, *as_many]), effects)
    closest, tried = with_each_searched_again(context, chosen, effects)
    return (chosen if closest is chosen else dropped_back(context, base, closest)), tried


def _without_effects(context: FitContext, base: Base, alone: Fitted, chosen: Fitted) -> tuple[Fitted, Fitted]:
    """Return the process alone twice where noise with a memory beside it explains more than effects do.

    A measured disturbance is known, and stays.
    """
    found = chosen.problem.effects
    if context.dataset.tuned or base.held is not None or not found or any(e.measured for e in found):
        return alone, chosen
    plain = with_third_lag(context, base.best)
    return (plain, plain) if is_noise_instead(context, plain, chosen) else (alone, chosen)


def _in_plainest_form(context: FitContext, chosen: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return an explanation with each effect in the plainest form that the record leaves to it."""
    chosen = with_one_pulse(context, with_one_form(context, chosen, effects), effects)
    chosen = with_plain_play(context, chosen, effects)
    chosen = with_best_moment(context, with_plain_step(context, simplest(context, chosen), effects))
    chosen = with_own_shapes(context, with_plain_limit(context, chosen, effects))
    chosen = with_smooth_course(context, with_plain_drift(context, chosen, effects), effects)
    return with_plain_forms(context, with_other_forms(context, chosen), effects)


def _with_processes(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return effects that are searched with a process of their own, until one of them leaves only noise."""
    found: list[Fitted] = []
    for more in _each_with_processes(context, base, effects):
        found += more
        if any(is_noise(context, candidate) for candidate in more):
            break
    return found


def _each_with_processes(context: FitContext, base: Base, effects: Sequence[Effect]) -> Iterator[list[Fitted]]:
    """Yield what each search finds: friction first where the valve is seen to stick, else updates and stages."""
    friction = (with_friction, with_friction_beside_a_load)
    sticks = waiting_of(context.dataset).sticks
    for search in (*friction, with_positions) if sticks else (with_positions, *friction):
        yield search(context, base, effects)
    yield with_process_friction(context, base.best)
    yield with_less_dead_time(context, base.origins, effects)
    for search in (
        with_varying_dead_time,
        with_process_beside_wave,
        with_switched_output,
        with_slow_output,
        with_curve_in_loop,
        with_curve_beside_a_load,
    ):
        yield search(context, base, effects)


def _fitted_again(context: FitContext, earlier: Sequence[Fitted]) -> list[Fitted]:
    """Return explanations by one effect of other samples, the closest of each name, fitted to these."""
    closest = [c for c in distinct(closest_first(earlier)) if len(c.problem.effects) == 1][:KNOWN]
    again = (
        fit(replace(c.problem, dataset=context.dataset, rows=context.fine), c.theta)
        for c in within(context.dataset.budget, closest)
    )
    return [c for c in again if is_physical(c)]


def _how_far(context: FitContext, best: Fitted) -> str:
    names = " and ".join(dict.fromkeys(best.reported_names()))
    return f"best so far {names}: {best.rms / max(noise_of(context, best), SMALLEST_DIVISOR):.1f} times the noise"


def _with_jump(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[list[Fitted]]:
    """Return the process with an obvious jump in an experiment; further effects are searched with it."""
    at_s = plain_jump(context.dataset) if context.dataset.tuned else None
    jump = form_of(effects, "bias_step")
    if at_s is None or jump is None:
        return []
    at_it = [replace(jump, starts=[(at_s / context.dataset.span_s,)])]
    return [[c] for origin in base.origins for c in extend(context, [origin], at_it)]


def _carried(
    context: FitContext, best: Fitted, found: Sequence[Fitted], sketches: Sequence[Sequence[Fitted]]
) -> list[list[Fitted]]:
    """Return the explanations that are extended next, in groups that compete for every further effect.

    Elsewhere than in an experiment, one effect in a free form follows two others closely, and hides both: the closest
    other ones are extended beside it.
    """
    if context.dataset.tuned:
        return [[c] for c in distinct(found)[:BEAM]]
    every = [*found, *(c for of in sketches for c in of)]
    single = [c for c in every if len(c.names) == 1 and is_physical(c)]
    free = is_free_load(context, best)
    other = [c for c in single if c.names != best.names or (free and not is_free_load(context, c))]
    others = distinct(closest_first(other))[:BEAM]
    groups = [[best]] if best.problem.effects or not others else []
    return [*groups, others] if others else groups


def _at_the_inputs(context: FitContext, beams: Sequence[Sequence[Fitted]]) -> list[list[Fitted]]:
    return [[at_the_input(context, candidate) for candidate in beam] for beam in beams]


def _with_free_curve(
    context: FitContext, base: Base, best: Fitted, declared: ProcessModel | None
) -> tuple[Fitted, list[Fitted]]:
    """Return an actuator with its own curve, or a soft limit, as explanation where no textbook effect explains it.

    One more effect is searched too, because a wrong curve hides it. A curve of many knots follows the fitted part more
    closely than the right effect of the actuator: it has to come as near on both parts.
    """
    alone = len(best.problem.effects) == 1 and is_near_noise(context, best)
    if alone or context.dataset.in_loop or context.dataset.budget.spent or base.held is not None:
        return best, []
    forms = [*static_curves(context.dataset), *soft_limits(context.dataset)]
    curves = extend(context, base.origins, forms)
    accepted = [c for c in curves if is_accepted(context, base, base.best, c)]
    if not accepted:
        return best, curves
    # Of a curve and steps of unequal size, steps: they are held to less.
    first = next((c for c in accepted if c.names == ("output_quantisation",)), accepted[0])
    beside = []
    if not is_near_noise(context, first):
        beside = extend(context, [first], catalogue(first, context.coarse, declared))
        accepted += [c for c in beside if is_accepted(context, base, first, c)]
    if any(effect.place is Place.ACTUATOR for effect in best.problem.effects):
        most = AS_NEAR * context.on_both_parts(best)
        accepted = [c for c in accepted if context.on_both_parts(c) < most]
    return context.best([best, *accepted]), [*curves, *beside]


def _from_its_process(context: FitContext, best: Fitted, declared: ProcessModel | None) -> Fitted:
    """Return the first effect, searched again from the process with the others, which is a closer start.

    So are the others at its place: from the process alone the search cannot separate a limit on both sides from a kink.
    """
    if not context.dataset.tuned or len(best.problem.effects) != 1 or is_near_noise(context, best):
        return best
    head = best.theta[: len(best.problem.structure.shape) + 1]
    origin = fit(replace(best.problem, effects=(), rows=context.coarse), head, 0)
    effects = catalogue(origin, context.coarse, declared)
    place = best.problem.effects[0].place
    found = extend(context, [origin], [e for e in effects if e.place is place])
    return context.best([best, *found])


def _following(context: FitContext, base: Base, best: Fitted, found: Sequence[Fitted]) -> tuple[Fitted, bool]:
    """Return the best explanation that is accepted, else the best; and whether it is accepted.

    An explanation that fits the fitted part better but fails on the other does not exclude one that is valid there.
    """
    inflated = min(context.colour(c) for c in found[:3])
    ordered = context.by_criterion(found, inflated)
    if context.dataset.tuned:
        chosen = next((c for c in ordered[:TRIED] if is_accepted(context, base, best, c)), None)
    else:
        tried = [c for k, c in enumerate(ordered) if k < TRIED_ELSEWHERE or SLIPS & set(c.names)]
        accepted = [c for c in tried if is_accepted(context, base, best, c)]
        sticking = that_stick(context, [best, *accepted]) if accepted else []
        by_chance = sticking or [c for c in accepted if not _has_an_answer(c)]
        ranked = best_on_both_parts(context, by_chance or accepted)
        chosen = _form_that_leaves_noise(context, ranked[0], accepted) if ranked else None
    return (ordered[0], False) if chosen is None or chosen is best else (chosen, True)


def _form_that_leaves_noise(context: FitContext, chosen: Fitted, accepted: Sequence[Fitted]) -> Fitted:
    """Return an explanation in the form that leaves only noise where its own leaves far more on the fitted part.

    A free form follows what a textbook one misses, and predicts less: of the same name, the closer one is the answer.
    """
    if not is_visible(context, chosen):
        return chosen
    forms = [c for c in accepted if c.names == chosen.names and is_near_noise(context, c)]
    return forms[0] if forms else chosen


def _has_an_answer(candidate: Fitted) -> bool:
    """Return whether a load begins or ends where one of a few moves of the output arrives."""
    problem = candidate.problem
    _, delay_s, _ = problem.split(candidate.theta)
    named = zip(problem.effects, candidate.sizes(), strict=True)
    return any(effect.name == LOAD and answers_a_move(sizes, problem.dataset, delay_s) for effect, sizes in named)


def _is_done(context: FitContext, best: Fitted, following: Fitted, *, accepted: bool) -> bool:
    """Return whether to stop: no time or nothing left, or nothing accepted though one effect was already."""
    if context.dataset.budget.spent:
        return True
    if accepted:
        white = context.colour(best) < COLOURED
        return white and is_near_noise(context, best) and _holds_later(context, best)
    return bool(best.problem.effects) or is_near_noise(context, following)


def _holds_later(context: FitContext, candidate: Fitted) -> bool:
    """Return whether an explanation holds on the other part; a load of free shape alone predicts nothing there."""
    if context.dataset.tuned:
        return True
    return is_near_later(context, candidate) and not is_free_load(context, candidate)


def _is_late(context: FitContext, base: Base, steps: Sequence[Fitted]) -> bool:
    """Return whether moves that arrive late leave nothing that a second effect could explain."""
    if len(steps) != 1:
        return False
    late, _ = with_uneven_updates(context, base, steps[0])
    return late is not steps[0] and is_noise(context, late)


def _steps_instead(context: FitContext, chosen: Fitted, pool: Sequence[Fitted]) -> list[Fitted]:
    """Return steps of the actuator in place of the closest curve that comes as near as another effect."""
    if len(chosen.problem.effects) != 1:
        return []
    curves = [c for c in pool if len(c.names) == 1 and set(c.names) <= CURVES and c.rms < NOTHING_LEFT * chosen.rms]
    return with_steps(context, closest_first(curves)[0])[1] if curves else []
