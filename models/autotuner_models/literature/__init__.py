"""Identification methods of the literature behind one interface, for comparison on the same records."""

from autotuner_models.literature import (
    cycle_equations,
    describing_function,
    dual_input,
    hysteresis,
    laplace,
    least_squares,
    neural_network,
    normalised_delay,
    online,
    sampled_data,
    state_space,
    step_integral,
    two_relays,
)
from autotuner_models.literature.trial import Method, Trial

METHODS: tuple[Method, ...] = tuple(
    module.METHOD
    for module in (
        describing_function,
        online,
        two_relays,
        dual_input,
        hysteresis,
        neural_network,
        cycle_equations,
        state_space,
        normalised_delay,
        laplace,
        sampled_data,
        step_integral,
        least_squares,
    )
)
"""All of them, in the order of comparison tables."""

__all__ = ["METHODS", "Method", "Trial"]
