"""Adjustment of the relay's bias to the middle of its oscillation.

Over a cycle the mean output equals the output in equilibrium with the reference, so the duty `d` shows where that is:

    u_eq = low + d (high - low)

The levels are moved so that `u_eq` lies at the requested duty between them. Where a level is at a limit of the output,
the reference is moved instead, in proportion: the PV in equilibrium with the resting output is known from the rest.

Adjustment of the relay's amplitude to the requested oscillation.

    k = wanted / A,  within 1/4 to 4;   h' = min(k h, h_max, limit by the PV limits)
    wanted = the requested amplitude, and 6 sigma at least

`A` PV amplitude of the last cycle, zero to peak, `sigma` noise of the PV, `h` relay amplitude, `h_max` the largest one
allowed. The levels are placed about the output at rest again, or, where the equilibrium has moved away from it, about
`low + d (high - low)` with the duty `d`, which is less certain in a transient; always inside the limits of the output.
For a linear process the PV follows in proportion, up to the dead zone of the relay; the next cycle corrects the
remaining error.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.experiment.relay import inside, place_levels

if TYPE_CHECKING:
    from autotuner.core.experiment.relay import Relay
    from autotuner.core.experiment.relay_phase.operating_point import OperatingPoint
    from autotuner.core.signals.detector import Cycle

LOPSIDED = 3.0
"""Ratio of the half periods beyond which a relay counts as lopsided."""
TARGET_DUTY = 0.36
"""Wanted share of the period at the rarer level: asymmetric enough to show the static gain."""
NEAREST = 0.05
"""Smallest distance of the equilibrium from rest, as a share of the swing, that scales the reference."""
FOLLOWS = 0.5
"""Share of what the reference was moved by that the equilibrium of a self-regulating process follows, at least."""
LEAST_WAY = 0.02
"""Distance of the equilibrium from rest, as a share of the swing, that is no more than its uncertainty."""


def is_lopsided(duty: float) -> bool:
    """Return whether the half periods differ by more than `LOPSIDED` to one."""
    return not 1.0 / (1.0 + LOPSIDED) <= duty <= LOPSIDED / (1.0 + LOPSIDED)


def recentred(
    relay: Relay,
    duty: float,
    rest: tuple[float, float],
    limits: tuple[float, float],
    pv_limits: tuple[float, float] = (-math.inf, math.inf),
) -> Relay:
    """Return the relay moved so that its duty comes near `TARGET_DUTY` (or its complement).

    Parameters
    ----------
    relay : Relay
        The relay as it oscillated.
    duty : float
        Share of the period it spent at the high level.
    rest : tuple of float
        Output and PV at rest before the experiment.
    limits, pv_limits : tuple of float
        Lowest and highest output, and PV, allowed.
    """
    swing = relay.high - relay.low
    equilibrium = relay.low + duty * swing
    wanted = TARGET_DUTY if duty < 0.5 else 1.0 - TARGET_DUTY
    low = inside(equilibrium - wanted * swing, swing, limits)
    moved = replace(relay, low=low, high=low + swing)
    if not is_lopsided((equilibrium - low) / swing):
        return moved
    (_, rest_pv), (lowest, highest) = rest, pv_limits
    nearest = [rest_pv + NEAREST_TO_LIMIT * (limit - rest_pv) for limit in (lowest, highest)]
    return replace(moved, reference=min(max(_moved_reference(moved, equilibrium, rest), nearest[0]), nearest[1]))


def shifted_in_vain(before: tuple[Relay, float], after: tuple[Relay, float], rest: tuple[float, float]) -> bool:
    """Return whether the output in equilibrium did not follow the reference, as in a process that integrates.

    Parameters
    ----------
    before, after : tuple of Relay and float
        Relay and duty before the reference was moved, and now.
    rest : tuple of float
        Output and PV at rest before the experiment.
    """
    rest_output, rest_pv = rest
    ways = [abs(relay.low + duty * (relay.high - relay.low) - rest_output) for relay, duty in (before, after)]
    references = [relay.reference - rest_pv for relay, _ in (before, after)]
    swing = after[0].high - after[0].low
    promised = ways[0] * abs(references[1] / references[0]) if references[0] else math.inf
    return ways[1] < max(FOLLOWS * promised, LEAST_WAY * swing)


def one_amplitude_further(relay: Relay, limits: tuple[float, float], *, is_high: bool) -> Relay:
    """Return the relay with both levels moved by its amplitude, towards the one it is at, inside the limits."""
    swing = relay.high - relay.low
    low = inside(relay.low + (relay.amplitude if is_high else -relay.amplitude), swing, limits)
    return replace(relay, low=low, high=low + swing)


def _moved_reference(relay: Relay, equilibrium: float, rest: tuple[float, float]) -> float:
    """Scale the distance of the reference from the resting PV, to move its equilibrium to the requested place."""
    rest_output, rest_pv = rest
    swing = relay.high - relay.low
    way = max(abs(equilibrium - rest_output) / swing, NEAREST)
    wanted = TARGET_DUTY if way < 0.5 else 1.0 - TARGET_DUTY
    return rest_pv + (relay.reference - rest_pv) * wanted / way


NOISE_MULTIPLE = 6.0
"""Smallest amplitude of the PV, in standard deviations of its noise."""
AIM = 1.25
"""Target amplitude where the noise requires a larger one, as a multiple of the smallest amplitude."""
NEAR = 1.4
"""Ratio to the requested amplitude within which the relay is not changed."""
LARGEST_STEP = 4.0
"""Largest ratio of two successive relay amplitudes."""
NEAREST_TO_LIMIT = 0.5
"""Largest amplitude of the PV for a strengthened relay, as a share of the distance to the nearer PV limit; and largest
distance of a moved reference from rest, as a share of that of the limit."""
SAME_PLACE = 0.25
"""Distance of the equilibrium from the output at rest, as a share of the swing, up to which the rest is accepted."""
WORTHWHILE = 1.1
"""Smallest change of the relay amplitude that is made."""


def adapted(relay: Relay, cycle: Cycle, rested: OperatingPoint) -> Relay | None:
    """Return the relay with the amplitude for the requested oscillation, or None without a change.

    Parameters
    ----------
    relay : Relay
        The relay of the oscillation.
    cycle : Cycle
        Its last full period.
    rested : OperatingPoint
        What it started from.
    """
    factor = min(max(_wanted(cycle.peak, rested) / cycle.peak, 1.0 / LARGEST_STEP), LARGEST_STEP)
    if factor > 1.0:
        low, high = rested.settings.limits.pv
        room = NEAREST_TO_LIMIT * min(high - relay.reference, relay.reference - low)
        factor = min(factor, rested.settings.largest_amplitude / relay.amplitude, room / cycle.peak)
    if 1.0 / WORTHWHILE < factor < WORTHWHILE or (factor <= 1.0 and cycle.peak < _least(rested)):
        return None
    return _scaled(relay, cycle.duty, factor, rested)


def strengthened(relay: Relay, rested: OperatingPoint, factor: float) -> Relay | None:
    """Return a stronger relay about the resting output, where nothing oscillated yet; None where none is allowed."""
    settings = rested.settings
    amplitude = min(relay.amplitude * min(factor, LARGEST_STEP), settings.largest_amplitude)
    levels = place_levels(rested.output, amplitude, settings.ratio, settings.relay_limits)
    if levels is None or amplitude < WORTHWHILE * relay.amplitude:
        return None
    return replace(relay, low=levels.low, high=levels.high)


def _least(rested: OperatingPoint) -> float:
    return NOISE_MULTIPLE * rested.quiet.disturbance_sigma


def _wanted(peak: float, rested: OperatingPoint) -> float:
    """Return the amplitude of the PV that is wanted; the present one where that will do."""
    requested, least = rested.settings.pv_amplitude, _least(rested)
    if requested is not None and not requested / NEAR <= peak <= requested * NEAR:
        return max(requested, AIM * least)
    return peak if peak >= least else AIM * least


def _scaled(relay: Relay, duty: float, factor: float, rested: OperatingPoint) -> Relay:
    swing, settings = relay.high - relay.low, rested.settings
    equilibrium = relay.low + duty * swing
    if not rested.levels.one_sided and abs(equilibrium - rested.output) < SAME_PLACE * swing:
        placed = place_levels(rested.output, factor * relay.amplitude, settings.ratio, settings.relay_limits)
        if placed is not None and not placed.one_sided:
            return replace(relay, low=placed.low, high=placed.high)
    scaled = factor * swing
    low = inside(equilibrium - duty * factor * swing, scaled, settings.relay_limits)
    return replace(relay, low=low, high=low + scaled)
