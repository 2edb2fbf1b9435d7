"""Serial ports without hardware: pseudo-terminals, joined or spoken to. POSIX only.

Invariants: bytes only; the emulated device interprets them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import tty
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

HUNG_UP_S = 0.02
"""Poll period for a client that opens the port, s."""


@contextlib.contextmanager
def open_port(link: Path | None = None) -> Iterator[tuple[int, str]]:
    """Make a pseudo-terminal; return the device's end as a file descriptor and the name of the client's.

    Parameters
    ----------
    link : Path, optional
        A symbolic link to make for the client's end; an existing link is replaced, any other file is not.

    Raises
    ------
    OSError
        `link` cannot be made.
    """
    device, client = pty.openpty()
    try:
        tty.setraw(client)
        os.set_blocking(device, False)
        name = os.ttyname(client)
        os.close(client)
        if link is not None:
            _replace(link, name)
        yield device, name
    finally:
        os.close(device)
        if link is not None and link.is_symlink() and str(link.readlink()) == name:
            link.unlink()


def _replace(link: Path, name: str) -> None:
    if link.is_symlink():
        link.unlink()
    link.symlink_to(name)


class PortReader:
    """Passes on what a client writes to a pseudo-terminal, and reports when a client opens it.

    Parameters
    ----------
    device : int
        The device's end.
    on_bytes : callable
        Takes each piece that arrives.
    on_open : callable, optional
        Called when a client opens the port.
    """

    def __init__(
        self, device: int, on_bytes: Callable[[bytes], None], on_open: Callable[[], None] = lambda: None
    ) -> None:
        self._device, self._on_bytes, self._on_open = device, on_bytes, on_open
        self._connected = False

    async def run(self) -> None:
        """Read until cancelled."""
        while True:
            try:
                piece = os.read(self._device, 4096)
            except BlockingIOError:
                self._note(connected=True)
                await self._readable()
            except OSError:  # the port is not open
                self._note(connected=False)
                await asyncio.sleep(HUNG_UP_S)
            else:
                self._note(connected=True)
                self._on_bytes(piece)

    def _note(self, *, connected: bool) -> None:
        if connected and not self._connected:
            self._on_open()
        self._connected = connected

    async def _readable(self) -> None:
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        loop.add_reader(self._device, ready.set)
        try:
            await ready.wait()
        finally:
            loop.remove_reader(self._device)


def send(device: int, message: bytes) -> None:
    """Write to a pseudo-terminal; unread bytes are lost, as on a real line."""
    with contextlib.suppress(OSError):
        os.write(device, message)


@contextlib.asynccontextmanager
async def joined_ports(link: Path) -> AsyncIterator[str]:
    """Make two serial ports joined by a wire; `link` names the client's, the name returned is the device's."""
    with open_port(link) as (near, _), open_port() as (far, device_port):
        pumps = [
            asyncio.create_task(PortReader(near, lambda piece: send(far, piece)).run()),
            asyncio.create_task(PortReader(far, lambda piece: send(near, piece)).run()),
        ]
        try:
            yield device_port
        finally:
            for pump in pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)
