"""Repeated reads of critical values, so that one damaged reading does no harm.

    seen_1 == seen_2     that is it
    otherwise            of each signal the middle of three readings

An output under control moves from reading to reading, and the middle one is as good as any.

Invariant: a value that is not a number in most readings is not a number.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from autotuner.ports import Backend


async def read_surely(backend: Backend, names: Collection[str]) -> dict[str, float]:
    """Return the named signals as most of up to three readings have them."""
    readings = [await backend.read(names), await backend.read(names)]
    if readings[0] != readings[1]:
        readings.append(await backend.read(names))
    return {name: _middle([reading[name] for reading in readings]) for name in names}


def _middle(values: list[float]) -> float:
    finite = sorted(filter(math.isfinite, values))
    return finite[len(finite) // 2] if 2 * len(finite) > len(values) else math.nan
