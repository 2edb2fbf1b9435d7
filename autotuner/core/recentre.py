"""Moving a lopsided relay to the middle of its oscillation.

Over a cycle the mean output equals the output in equilibrium with the reference, so the duty `d` tells where that is:

    u_eq = low + d (high - low)

The levels are moved so that `u_eq` lies at the wanted duty between them. Where a level is at a limit of the output, the
reference is moved instead, in proportion: the PV in equilibrium with the resting output is known from the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.relay import Relay

LOPSIDED = 3.0
"""Ratio of the half periods beyond which a relay counts as lopsided."""
TARGET_DUTY = 0.36
"""Wanted share of the period at the rarer level: asymmetric enough to show the static gain."""
NEAREST = 0.05
"""Smallest share of the way from rest that is believed when the reference is scaled."""


def is_lopsided(duty: float) -> bool:
    """Return whether the half periods differ by more than `LOPSIDED` to one."""
    return not 1.0 / (1.0 + LOPSIDED) <= duty <= LOPSIDED / (1.0 + LOPSIDED)


def recentred(relay: Relay, duty: float, rest: tuple[float, float], limits: tuple[float, float]) -> Relay:
    """Return the relay moved so that its duty comes near `TARGET_DUTY` (or its complement).

    Parameters
    ----------
    relay : Relay
        The relay as it oscillated.
    duty : float
        Share of the period it spent at the high level.
    rest : tuple of float
        Output and PV at rest before the experiment.
    limits : tuple of float
        Lowest and highest output allowed.
    """
    swing = relay.high - relay.low
    equilibrium = relay.low + duty * swing
    wanted = TARGET_DUTY if duty < 0.5 else 1.0 - TARGET_DUTY
    low = min(max(equilibrium - wanted * swing, limits[0]), limits[1] - swing)
    moved = replace(relay, low=low, high=low + swing)
    if not is_lopsided((equilibrium - low) / swing):
        return moved
    return replace(moved, reference=_moved_reference(moved, equilibrium, rest))


def _moved_reference(relay: Relay, equilibrium: float, rest: tuple[float, float]) -> float:
    """Scale the way of the reference from the resting PV, so that its equilibrium comes to the wanted place."""
    rest_output, rest_pv = rest
    swing = relay.high - relay.low
    way = max(abs(equilibrium - rest_output) / swing, NEAREST)
    wanted = TARGET_DUTY if way < 0.5 else 1.0 - TARGET_DUTY
    return rest_pv + (relay.reference - rest_pv) * wanted / way
