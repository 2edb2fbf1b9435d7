"""Identification methods of the literature behind one interface, for comparison on the same records."""

from autotuner_models.literature import (
    describing_functions,
    exact_cycle,
    laplace,
    least_squares,
    neural_network,
    normalised_delay,
    sampled_data,
    step_integral,
    two_relays,
)
from autotuner_models.literature.trial import Method, Trial

METHODS: tuple[Method, ...] = (
    describing_functions.OFFLINE,
    describing_functions.ONLINE,
    two_relays.METHOD,
    describing_functions.DUAL_INPUT,
    describing_functions.WITH_HYSTERESIS,
    neural_network.METHOD,
    exact_cycle.CLOSED_FORM,
    exact_cycle.STATE_SPACE,
    normalised_delay.METHOD,
    laplace.METHOD,
    sampled_data.METHOD,
    step_integral.METHOD,
    least_squares.METHOD,
)
"""All of them, in the order of comparison tables."""

__all__ = ["METHODS", "Method", "Trial"]
