"""Acceptance of an explanation: against one with fewer effects, and of each of its effects against those that stay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.diagnosis.search.judge import (
    NOISE_ELSEWHERE,
    VISIBLE,
    is_foreseen,
    is_helpful,
    is_near_noise,
    is_supported,
    noise_of,
    weigh,
    weighs_enough,
)
from autotuner.core.diagnosis.search.search import disturbances_of, without

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

NEAR = 1.5
"""Error over that of the best explanation up to which friction is named where the valve is seen to stick."""


def is_noise(context: FitContext, candidate: Fitted) -> bool:
    """Return whether a candidate leaves white noise of the size that the sensor has, on both parts."""
    noise, held = noise_of(context, candidate), context.held_out_residual(candidate)
    quiet = float(held @ held) < held.size * (NOISE_ELSEWHERE * noise) ** 2
    return quiet and leaves_white_noise(context, candidate)


def leaves_white_noise(context: FitContext, candidate: Fitted) -> bool:
    """Return whether a candidate leaves white noise of the size that the sensor has on the fitted part."""
    return is_near_noise(context, candidate) and context.colour(candidate) == 1.0


def is_near_later(context: FitContext, candidate: Fitted) -> bool:
    """Return whether an explanation predicts the other part, or errs there by no more than its numbers may be off."""
    noise = noise_of(context, candidate)
    return context.held_out_error(candidate) < VISIBLE * noise or is_foreseen(context, candidate, noise)


def is_free_load(context: FitContext, candidate: Fitted) -> bool:
    """Return whether the one effect is a load of free shape.

    It follows whatever else the fitted part has, such as a relay's equal periods, or two effects.
    """
    effects = candidate.problem.effects
    return not context.dataset.tuned and len(effects) == 1 and effects[0].reads_as is not None


def _predicts_instead(context: FitContext, before: Fitted, after: Fitted) -> bool:
    """Return whether effects of fewer numbers, which predict the other part, leave noise in place of a free load."""
    if not is_free_load(context, before) or any(e.reads_as is not None for e in after.problem.effects):
        return False
    leaves_noise = is_near_noise(context, after) and is_near_later(context, after)
    return leaves_noise and context.criterion(after, 1.0) < context.criterion(before, 1.0)


def is_accepted(context: FitContext, base: Base, before: Fitted, after: Fitted) -> bool:
    """Return whether an explanation with more effects is accepted against one with fewer."""
    first = all(e.measured for e in before.problem.effects)  # measured disturbances are given, not found
    new = [e for e in after.problem.effects if e.name not in before.names]
    seen = any(not e.unseen_after for e in new)
    if context.dataset.tuned and not first and not seen:
        return False  # an experiment begins at rest: what mends its beginning mends something else
    if first and base.held is not None and after.problem.fixed is not None:
        # With the declared values held, the effect has to beat other values of the same model, too.
        against = weigh(context, base.held, after)
        inflated = context.colour(after)
        return is_supported(against, first=True, seen_held_out=seen) and context.criterion(
            after, inflated
        ) < context.criterion(before, inflated)
    if _predicts_instead(context, before, after):
        return True
    if not is_supported(weigh(context, before, after), first=first, seen_held_out=seen):
        return False
    instead = not context.dataset.tuned and not set(before.names) <= set(after.names)  # no mend of the first one's form
    return first or instead or weighs_enough(context, base.best, before, after)


def dropped_back(context: FitContext, base: Base, best: Fitted) -> Fitted:
    """Remove every effect that is no longer needed, as long as what is left means what its names say.

    A disturbance among what is left gets another form later, if its numbers are not those of this one.
    """
    if len(best.problem.effects) < 2:
        return best
    # What was measured goes last: a guess that is not needed beside it gives way first.
    for effect in sorted(best.problem.effects, key=lambda e: e.measured):
        simpler = without(context, best, effect)
        evidence = weigh(context, simpler, best)
        if effect.measured and (is_helpful(evidence) or not is_noise(context, simpler)):
            continue  # it is known to act: a guess that leaves more than noise does not take its place
        if effect.name in SLIPS and that_stick(context, [simpler, best]):
            continue
        needed = is_supported(evidence, first=False, seen_held_out=not effect.unseen_after)
        needed = needed and weighs_enough(context, base.best, simpler, best)
        # One effect alone has to be accepted, too: two may only hold together.
        alone = len(simpler.problem.effects) > 1 or is_accepted(context, base, base.best, simpler)
        if alone and not needed and (is_physical(simpler) or disturbances_of(simpler.problem.effects)):
            return dropped_back(context, base, simpler)
    return best


def that_stick(context: FitContext, accepted: Sequence[Fitted]) -> list[Fitted]:
    """Return of accepted explanations those with friction that come near the best, where the valve is seen to stick.

    The waiting of the PV is evidence that no misfit contains: a free load follows a slip as closely as friction does.
    """
    if not accepted or not waiting_of(context.dataset).sticks:
        return []
    best = min(context.on_both_parts(c) for c in accepted)
    frictional = [c for c in accepted if SLIPS & set(c.names)]
    return [c for c in frictional if context.on_both_parts(c) < NEAR**2 * best]
