"""The literature's methods of identification behind one interface, to be compared on the same records."""

from autotuner.core.identification.methods import (
    cycle_equations,
    describing_function,
    dual_input,
    laplace,
    least_squares,
    normalised_delay,
    online,
    sampled_data,
    state_space,
    step_integral,
    two_relays,
)
from autotuner.core.identification.methods.trial import Method, Trial

METHODS: tuple[Method, ...] = tuple(
    module.METHOD
    for module in (
        describing_function,
        online,
        two_relays,
        dual_input,
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
