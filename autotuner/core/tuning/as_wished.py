"""Gains for a process as somebody wants them: a `Wish` on its `Basis`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.tuning.tuner import tune

if TYPE_CHECKING:
    from autotuner.core.tuning.result import Tuning
    from autotuner.core.tuning.wish import Basis, Wish

NO_NOISE = "no noise was measured, so the wished jitter of the output limits nothing"


def gains_as_wished(basis: Basis, wish: Wish) -> Tuning:
    """Return gains for a process as somebody wants them.

    Raises
    ------
    InputError
        As of `tune`.
    """
    found = tune(
        basis.model,
        wish.requirements(basis.noise),
        wish.rule,
        tau_c_s=wish.tau_c_s,
        covariance=basis.covariance,
        known_as=basis.known_as,
        sample_time_s=basis.sample_time_s,
        noise=basis.noise,
    )
    unlimited = (NO_NOISE,) if wish.jitter is not None and basis.noise is None else ()
    return replace(found, goal=None if wish.rule else wish.name, warnings=(*found.warnings, *unlimited))
