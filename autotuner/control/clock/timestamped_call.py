"""When a call to a device did what it was for.

    moment = (request + answer)/2      of the exchange that counted, where the driver knows it (`autotuner.ports.Timed`)
    moment = (start + end)/2           of the whole call, where it does not

A line that damages one frame in ten makes a driver ask again for a second before it has its answer. What it then holds
was measured in the last exchange, not when it was first requested; and a record that is wrong by that second is wrong
in its model. Half of the round trip before the answer is the least biased guess of the moment within the exchange.

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
    """Return what a call of the backend returns, and its moment, s since the ticker was made."""
    started_s = ticker.now_s
    result = await call
    ended_s = ticker.now_s
    measured_s = ticker.since(getattr(backend, "moment_s", math.nan))
    middle_s = (started_s + ended_s) / 2.0 if math.isnan(measured_s) else measured_s
    return result, min(max(middle_s, started_s), ended_s)
