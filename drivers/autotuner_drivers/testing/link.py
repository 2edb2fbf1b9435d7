"""A TCP link between a driver and its device that can be cut, held and restored."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit, urlunsplit

if TYPE_CHECKING:
    from collections.abc import Mapping

LOCAL: Final = "127.0.0.1"
NOBODY: Final = 1
"""A port without a listener."""
CHUNK: Final = 65536
"""Bytes of one read of a connection that is passed on."""
DEFAULT_PORTS: Final = {"topics": 1883, "variables": 102, "channels": 5064, "tags": 44818}
"""Ports of the protocols by the table of signals that identifies them; that of Modbus is 502."""


class TcpLink:
    """Forwards connections to a device; `cut` resets them and refuses new ones, `hold` holds all bytes back.

    Parameters
    ----------
    host, port
        Address of the device.
    """

    def __init__(self, host: str, port: int) -> None:
        self._device = (host, port)
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._flows = asyncio.Event()
        self._refuses = False
        self._server: asyncio.Server | None = None
        self.port = 0

    async def start(self) -> None:
        """Listen on a free port of this machine."""
        self._flows.set()
        self._server = await asyncio.start_server(self._serve, LOCAL, 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def cut(self) -> None:
        """Reset all connections; reset new ones immediately."""
        self._refuses = True
        for writer in self._writers:
            writer.transport.abort()
        await asyncio.sleep(0.0)

    async def hold(self) -> None:
        """Hold all bytes back; connections remain open."""
        self._flows.clear()

    async def restore(self) -> None:
        """Forward again, starting with the held bytes."""
        self._refuses = False
        self._flows.set()

    async def close(self) -> None:
        """Close all connections and stop listening."""
        await self.cut()
        self._flows.set()
        if self._server is not None:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - narrows the type: a coroutine runs in a task
        self._tasks.add(task)
        far_writer: asyncio.StreamWriter | None = None
        try:
            if self._refuses:
                return
            far_reader, far_writer = await asyncio.open_connection(*self._device)
            self._writers |= {writer, far_writer}
            async with asyncio.TaskGroup() as both:
                both.create_task(self._pass(reader, far_writer))
                both.create_task(self._pass(far_reader, writer))
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            for end in (writer, far_writer):
                if end is not None:
                    end.transport.abort()
            self._writers -= {writer, far_writer} if far_writer else {writer}
            self._tasks.discard(task)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(CHUNK):
                await self._flows.wait()
                writer.write(data)
                await writer.drain()
        writer.transport.abort()


def address_of(options: Mapping[str, object]) -> tuple[str, int] | None:
    """Return host and port of a driver's options; None for a device without an address, or one with TLS."""
    endpoint, host, port = options.get("endpoint"), options.get("host"), options.get("port")
    if isinstance(endpoint, str):
        parts = urlsplit(endpoint)
        return (parts.hostname, parts.port or 4840) if parts.hostname else None
    secure = options.get("tls") or options.get("transport") == "tls"
    default = next((port for table, port in DEFAULT_PORTS.items() if table in options), 502)
    return None if secure or not isinstance(host, str) else (host, port if isinstance(port, int) else default)


def moved(options: Mapping[str, object], port: int) -> dict[str, object]:
    """Return the options of a device that is reached through a local port."""
    if isinstance(endpoint := options.get("endpoint"), str):
        return dict(options) | {"endpoint": urlunsplit(urlsplit(endpoint)._replace(netloc=f"{LOCAL}:{port}"))}
    direct = {"search": False} if "channels" in options else {}
    return dict(options) | {"host": LOCAL, "port": port} | direct


def absent(options: Mapping[str, object]) -> dict[str, object] | None:
    """Return the options of a device that does not exist; None where the options have no address."""
    if "serial_port" in options:
        return dict(options) | {"serial_port": "/dev/no-such-port"}
    return moved(options, NOBODY) if address_of(options) else None
