"""The estimators under comparison, each from amplitude and period of a limit cycle under the thesis's relay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function
from autotuner_models import first_order_cycle

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.core.model.process import Fopdt, ProcessModel

H = 1.0
"""Half the swing of the relay in all tests of the thesis."""


def by_describing_function(structure: str, truth: Mapping[str, float], A: float, Pu: float) -> ProcessModel:
    """Return the describing function's model; static gain and, for second order, dead time are given."""
    by_structure: dict[str, Callable[[], ProcessModel]] = {
        "fopdt": lambda: describing_function.fopdt(truth["K"], H, A, Pu),
        "sopdt_overdamped": lambda: describing_function.sopdt(truth["K"], truth["D"], H, A, Pu),
        "sopdt_underdamped": lambda: describing_function.sopdt(truth["K"], truth["D"], H, A, Pu),
    }
    return by_structure[structure]()


def by_peak(K: float, A: float, Pu: float) -> Fopdt | None:
    """Return the closed form on the peak, or None where `1 - e^{-D/T}` is 1 in floating point."""
    return first_order_cycle.fopdt_symmetric(K, H, A, Pu) if A < K * H else None


def by_fundamental(K: float, A1: float, Pu: float) -> Fopdt:
    """Return the closed form on the fundamental."""
    return first_order_cycle.fopdt_by_fundamental(K, H, A1, Pu)
