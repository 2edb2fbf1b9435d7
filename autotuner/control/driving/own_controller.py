"""A loop whose device has a controller of its own: required signals, and the state in which it is found.

Invariant: an operation that cannot be reversed does not begin. A device that reports no finite value is refused.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.control.devices.confirmed_read import read_surely
from autotuner.control.records.lease_record import Before
from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Collection

    from autotuner.ports import Backend

SIGNALS = (PV, OUTPUT, SET_POINT, AUTO)
"""Signals that are read from a loop under its device's own controller."""


def missing_signals(backend: Backend, written: Collection[str]) -> list[str]:
    """Return those of `SIGNALS` that the device does not offer for reading, or for writing where they are `written`."""
    return [name for name in SIGNALS if name not in backend.readable or name in set(written) - backend.writable]


async def find_loop(device: Backend, done: str, written: Collection[str]) -> Before:
    """Return how the loop is found.

    Parameters
    ----------
    device : Backend
        Connected.
    done : str
        What is to be done with the loop, as a participle: "verified".
    written : collection of str
        The signals that are written for it.

    Raises
    ------
    DriverError
        The device does not answer, lacks a signal, or reports no finite value of one that must be restored.
    """
    if missing := missing_signals(device, written):
        raise DriverError(
            f"the loop cannot be {done} without {', '.join(missing)}",
            remedy="Map output, set_point and auto of the device's own controller; "
            f"{' and '.join(written)} must be writable.",
        )
    readings = await read_surely(device, SIGNALS)
    unknown = [name for name in (OUTPUT, SET_POINT, AUTO) if not math.isfinite(readings[name])]
    if unknown:
        raise DriverError(
            f"the device does not report its present {', '.join(unknown)}, so the loop could not be restored",
            remedy="Check the device and the mapping of these signals.",
        )
    return Before(readings[OUTPUT], readings[AUTO], readings[SET_POINT])
