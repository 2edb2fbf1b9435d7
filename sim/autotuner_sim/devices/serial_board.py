"""A board on a pseudo-terminal: the wire and the clock of `TclabBoard`. POSIX only."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from autotuner_sim.devices.serial_wire import PortReader, open_port, send

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from autotuner_sim.devices.tclab_board import TclabBoard


@contextlib.asynccontextmanager
async def serving_board(board: TclabBoard, link: Path, *, speed: float = 1.0) -> AsyncIterator[None]:
    """Serve a board on a new serial port.

    Parameters
    ----------
    board : TclabBoard
        What is served.
    link : Path
        Symbolic link to make for the master's end.
    speed : float
        Seconds of the plant per second of the clock.
    """
    loop = asyncio.get_running_loop()
    start_s = loop.time()

    with open_port(link) as (device, _):

        def advance() -> None:
            board.advance((loop.time() - start_s) * speed)

        def on_open() -> None:
            advance()
            board.reset()

        def on_bytes(piece: bytes) -> None:
            advance()
            send(device, board.receive(piece))

        reader = asyncio.create_task(PortReader(device, on_bytes, on_open).run())
        try:
            yield
        finally:
            reader.cancel()
            await asyncio.gather(reader, return_exceptions=True)
