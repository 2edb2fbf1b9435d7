"""Time of the measurement or action within a call to a device.

    moment = (request + answer)/2      of the successful exchange, where the driver reports it (`autotuner.ports.Timed`)
    moment = (start + end)/2           of the whole call otherwise

On a line that damages one frame in ten, a driver may repeat a request for a second. The value was measured in the last
exchange, not at the first request, and an error of a second in the record is an error in its model. The middle of the
last exchange is the least biased estimate.

Invariant: a moment always lies within its call, whatever the driver reports.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from autotuner.ports import Repeating

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from autotuner.control.clock.ticker import Ticker
    from autotuner.ports import Backend

T = TypeVar("T")


def repeated_by(backend: Backend) -> int:
    """Return how many requests a backend has repeated since it was made; 0 where it does not report it."""
    return backend.repeated if isinstance(backend, Repeating) else 0


async def timed(call: Awaitable[T], backend: Backend, ticker: Ticker) -> tuple[T, float]:
    """Return the result of a call of the backend and its moment, s since the start of the ticker."""
    started_s = ticker.now_s
    result = await call
    ended_s = ticker.now_s
    measured_s = ticker.since(getattr(backend, "moment_s", math.nan))
    middle_s = (started_s + ended_s) / 2.0 if math.isnan(measured_s) else measured_s
    return result, min(max(middle_s, started_s), ended_s)
