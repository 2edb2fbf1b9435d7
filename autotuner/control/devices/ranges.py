"""Checks a loop's limits against the range of its device.

An output limit that the register cannot hold fails in the middle of a tuning, at the first level beyond it; a PV limit
that the register cannot represent is never exceeded, however hot it gets. Both are found before anything is connected.

Invariant: only a device that reports its ranges (`autotuner.ports.Ranged`) is checked.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from autotuner.errors import ConfigurationError
from autotuner.ports import OUTPUT, PV, Ranged

if TYPE_CHECKING:
    from collections.abc import Iterator

    from autotuner.core.experiment.settings import Limits
    from autotuner.ports import Backend


class Unholdable(NamedTuple):
    """A limit that the device cannot hold: key, value, message and remedy."""

    key: str
    value: float
    message: str
    remedy: str


def unholdable(limits: Limits, backend: Backend) -> Unholdable | None:
    """Return the first limit that the device cannot hold; None where all fit, or the device reports no range."""
    if not isinstance(backend, Ranged):
        return None
    for key, signal, value in _values(limits):
        lowest, highest = backend.limits(signal)
        if not lowest <= value <= highest:
            span = f"{lowest:g} to {highest:g}"
            remedy = f"Give a limit within {span}, or correct type, scale and offset of the {signal}."
            return Unholdable(key, value, f"is outside of the device's range, {span}", remedy)
    return None


def check_ranges(limits: Limits, backend: Backend, field: str) -> None:
    """Refuse limits that the device cannot hold.

    Raises
    ------
    ConfigurationError
        Names the key below `field`, the value and the remedy.
    """
    if (found := unholdable(limits, backend)) is not None:
        raise ConfigurationError(found.message, field=f"{field}.{found.key}", value=found.value, remedy=found.remedy)


def _values(limits: Limits) -> Iterator[tuple[str, str, float]]:
    yield from (("limits.output", OUTPUT, value) for value in limits.output)
    if limits.safe_output is not None:
        yield "limits.safe_output", OUTPUT, limits.safe_output
    yield from (("limits.pv", PV, value) for value in limits.pv if math.isfinite(value))
