"""One connection to a Modbus device: made, lost, made again.

Invariants:

1. The connection is made by the call that needs it. After a failed attempt, calls fail at once until the pause is over
   (`backoff`).
2. A connection that the device closes is made again at once, without waiting for the next call. From the second on that
   it closes before it has answered anything, that counts as a failed attempt. A closed connection stays closed.
3. `lost` reports a loss in the moment of connecting, after which the library believes itself connected for ever.
4. `gone` is called at every attempt that the device itself refuses or resets: the first comes milliseconds after a
   loss. One that only takes too long may have been lost on the way.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from autotuner.errors import DriverError
from autotuner_drivers.links import Backoff, put_off
from autotuner_drivers.modbus.lines import Hooks
from autotuner_drivers.modbus.protocol import driver_error, not_open

if TYPE_CHECKING:
    from collections.abc import Callable

    from pymodbus.client.base import ModbusBaseClient

    from autotuner_drivers.modbus.lines import Line


class ModbusConnection:
    """The connection of one link, which calls it in turns only.

    Parameters
    ----------
    line : Line
        The line.
    device : str
        The device's name in messages.
    timeout_s : float
        Longest wait for a connection, s.
    max_silent : int
        After so many requests without an answer in a row the library closes the connection at the next one.
    on_packet : callable
        Sees every packet, see `Hooks`.
    turn : asyncio.Lock
        Held by the user of the connection.
    """

    def __init__(
        self,
        line: Line,
        device: str,
        timeout_s: float,
        max_silent: int,
        on_packet: Callable[[bool, bytes], bytes],
        turn: asyncio.Lock,
    ) -> None:
        self._line, self._device, self._timeout_s = line, device, timeout_s
        self._max_silent, self._on_packet, self._turn = max_silent, on_packet, turn
        self._client: ModbusBaseClient | None = None
        self._again: asyncio.Task[None] | None = None
        self._backoff = Backoff()
        self._opened = self._answered = False
        self._unanswered = 0
        self.lost: asyncio.Future[None] | None = None
        self.gone: Callable[[str], None] | None = None

    @property
    def current(self) -> ModbusBaseClient | None:
        """The connected client; None when there is no connection, as far as is known."""
        client, lost = self._client, self.lost
        return None if client is None or lost is None or lost.done() or not client.connected else client

    @property
    def up(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self.current is not None

    async def open(self) -> None:
        """Connect now, without regard to an earlier failure; nothing when connected."""
        self._opened = True
        self._backoff.forgive()
        await self.client()

    async def close(self) -> None:
        """Disconnect; a request under way fails."""
        self._opened = False
        self._drop()
        if self._again is not None:
            self._again.cancel()
            await asyncio.gather(self._again, return_exceptions=True)
            self._again = None

    def answered(self) -> None:
        """Take note that the device has answered over this connection."""
        if not self._answered:
            self._answered = True
            self._backoff.succeeded()

    async def client(self) -> ModbusBaseClient:
        """Return a connected client; raise `LinkError` when there is none to be had now."""
        if not self._opened:
            raise not_open(self._device)
        if (current := self.current) is not None:
            return current
        wait_s = self._backoff.wait_s(asyncio.get_running_loop().time())
        if wait_s > 0.0:
            reason = self._backoff.reason
            raise put_off(driver_error(reason, self._device, self._timeout_s), wait_s) from reason
        return await self._connect()

    async def _connect(self) -> ModbusBaseClient:
        self._drop()
        loop = asyncio.get_running_loop()
        lost: asyncio.Future[None] = loop.create_future()
        hooks = Hooks(lambda up: self._on_connection(lost, up), self._on_packet)
        client = self._line.client(self._timeout_s, hooks)
        client.set_max_no_responses(self._max_silent)
        reason = await _dial(client)
        if reason is None and lost.done():
            client.close()
            reason = ConnectionResetError("the connection was closed in the moment in which it was made")
        if reason is not None:
            raise self._fail(reason) from reason
        self._client, self.lost, self._answered = client, lost, False
        return client

    def _fail(self, reason: Exception) -> DriverError:
        """Take note of a failed attempt, and return it as an error of the port."""
        self._backoff.failed(asyncio.get_running_loop().time(), reason)
        error = driver_error(reason, self._device, self._timeout_s)
        if self.gone is not None and isinstance(reason, ConnectionError):
            self.gone(str(error))
        return error

    def _on_connection(self, lost: asyncio.Future[None], up: bool) -> None:  # noqa: FBT001 - the library's signature
        """Take note of a loss, and begin to connect again unless it was wanted."""
        if up or lost.done():
            return
        lost.set_result(None)
        if lost is not self.lost or not self._opened:
            return
        self._unanswered = 0 if self._answered else self._unanswered + 1
        if self._unanswered < 2:
            self._again = asyncio.ensure_future(self._connect_again())
        else:
            self._fail(ConnectionResetError("the connection was closed before anything was answered"))

    async def _connect_again(self) -> None:
        async with self._turn:
            if self._opened and not self.up:
                with contextlib.suppress(DriverError):  # the next call reports it, and tries again
                    await self._connect()

    def _drop(self) -> None:
        client, self._client = self._client, None
        if self.lost is not None and not self.lost.done():
            self.lost.set_result(None)
        if client is not None:
            client.close()


async def _dial(client: ModbusBaseClient) -> Exception | None:
    """Connect; return why it failed, which the library only logs, or lets through when it is no `OSError`."""
    reason: Exception = TimeoutError("no connection within the time limit")
    create = client.ctx.call_create

    async def create_and_note() -> object:
        nonlocal reason
        try:
            return await create()
        except Exception as error:
            reason = error
            raise OSError(str(error)) from error

    client.ctx.call_create = create_and_note
    return None if await client.connect() else reason
