"""The output that a device takes when it goes to manual, where its manual register does not follow in auto.

    |manual - held| <= allowed          going to manual moves nothing
    otherwise                           the held output is written while the device is in auto, and looked at again

`manual_output` is the register as it can be read; `output` is then the feedback of what is applied, and written to that
register. A device without `manual_output` is taken to follow, as most do.

Invariant: the mode is not changed before the register is seen at the held output. Where it takes nothing in
auto, that is a refusal which states what would jump, and by how much.
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
        Largest jump that is no more than noise, output units.
    scan_s : float
        Time after which the device acts on what was written, s.
    """

    async def differs_by() -> float:
        return (await device.read([MANUAL_OUTPUT]))[MANUAL_OUTPUT] - held

    if MANUAL_OUTPUT not in device.readable or abs(await differs_by()) <= allowed:
        return None
    why = "its manual register does not take what is written in auto"
    try:
        await write(held)
    except DriverError as error:
        why = f"it refuses to be written in auto ({error.finding})"
    await asyncio.sleep(scan_s)
    if abs(jump := await differs_by()) <= allowed:
        return None
    return refused(
        "manual_output_differs",
        f"in manual the output would jump by {jump:+.4g}, from {held:.4g} to {held + jump:.4g}: {why}",
        f"Set the manual output of the device to {held:.4g}, or put it to manual by hand, then start again.",
    )
