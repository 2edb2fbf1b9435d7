"""A client of the library as the driver uses it: on serial lines, and on gateways to them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from autotuner_drivers.modbus_requests import send_by_library

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from pymodbus.client.base import ModbusBaseClient
    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.modbus_requests import Request

# The library's warnings repeat what the driver's errors say; without a handler they would go to stderr.
logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())


class LibraryClient:
    """A connection made by the library; implements `modbus_lines.Client`.

    Parameters
    ----------
    client : ModbusBaseClient
        Not yet connected.
    """

    def __init__(self, client: ModbusBaseClient) -> None:
        self._client = client

    @property
    def connected(self) -> bool:
        """Whether there is a connection, as far as the library knows."""
        return bool(self._client.connected)

    async def dial(self) -> Exception | None:
        """Connect; return why it failed, which the library only logs, or lets through when it is no `OSError`."""
        reason: Exception = TimeoutError("no connection within the time limit")
        create = self._client.ctx.call_create

        async def create_and_note() -> object:
            nonlocal reason
            try:
                return await create()
            except Exception as error:
                reason = error
                raise OSError(str(error)) from error

        self._client.ctx.call_create = create_and_note
        return None if await self._client.connect() else reason

    def ask(self, request: Request, unit: int) -> Awaitable[ModbusPDU]:
        """Send a request and return its answer."""
        return send_by_library(request, self._client, unit)

    def close(self) -> None:
        """Disconnect."""
        self._client.close()
