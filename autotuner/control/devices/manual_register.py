"""The output of a device at the change to manual, where its manual register does not follow in auto.

    |manual - held| <= allowed          the change to manual moves nothing
    otherwise                           the held output is written to the register in auto, and confirmed by a read

`manual_output` is the readable register; `output` is then the feedback of the applied output, and is written to that
register. A device without `manual_output` is assumed to follow, as most do.

Invariant: the mode does not change before the register holds the output. A register that ignores writes in
auto is a refusal that reports the size of the bump.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from autotuner.core.verdict import Verdict, refused
from autotuner.errors import DriverError
from autotuner.ports import MANUAL_OUTPUT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from autotuner.ports import Backend


async def preload(
    device: Backend, write: Callable[[float], Awaitable[object]], held: float, allowed: float, scan_s: float
) -> Verdict | None:
    """Have the manual register of a device in auto hold an output; return why it may not go to manual, or None.

    Parameters
    ----------
    device : Backend
        The device; read here.
    write : callable
        Writes an output to it.
    held : float
        Output that is to be held in manual, output units.
    allowed : float
        Largest jump within noise, output units.
    scan_s : float
        Time after which the device acts on a write, s.
    """

    async def differs_by() -> float:
        return (await device.read([MANUAL_OUTPUT]))[MANUAL_OUTPUT] - held

    if MANUAL_OUTPUT not in device.readable or abs(await differs_by()) <= allowed:
        return None
    reason = "its manual register ignores writes in auto"
    try:
        await write(held)
    except DriverError as error:
        reason = f"it refuses to be written in auto ({error.finding})"
    await asyncio.sleep(scan_s)
    if abs(jump := await differs_by()) <= allowed:
        return None
    return refused(
        "manual_output_differs",
        f"in manual the output would jump by {jump:+.4g}, from {held:.4g} to {held + jump:.4g}: {reason}",
        f"Set the manual output of the device to {held:.4g}, or put it to manual by hand, then start again.",
    )
