"""Requests and answers of Modbus TCP and TLS through the library, without what its `execute` spends on each of them.

`execute` takes a lock, a task, a timer and two message objects a request. Here a request is one future; one timer
looks at the time limits of many requests, and the usual answer is known by its bytes (`modbus_forms`).

Rules of this file:

1. One request at a time: whoever uses a client takes turns.
2. An answer is taken by its bytes only when it came whole, alone and just as it should, with its transaction and unit.
   Everything else goes the library's way, which joins pieces, passes over what belongs to another request, and decodes.
3. A request ends with an answer, with one that nobody can read, at its time limit, or with the connection.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, cast

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException

from autotuner_drivers.modbus_forms import FRAMER, form_of

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU
    from pymodbus.transaction import TransactionManager

    from autotuner_drivers.modbus_forms import Form
    from autotuner_drivers.modbus_requests import Request


LAST_TRANSACTION: Final = 65_000
"""As the library counts them."""


class UnreadableAnswerError(ModbusException):
    """An answer to the request under way came that cannot be decoded."""


class Exchange(asyncio.Protocol):
    """Stands between a connection and the library's end of it.

    What a request needs is in slots, near to each other: of a thousand connections, most are not in the processor's
    caches when their turn comes.
    """

    __slots__ = (
        *("transport", "loop", "_manager", "_answer", "_form", "_transaction", "_unit"),
        *("_in_pieces", "_silent", "_due_s", "_timer", "_timeout_s"),
    )

    def __init__(self, manager: TransactionManager) -> None:
        self._manager, self.loop = manager, asyncio.get_running_loop()
        self._timeout_s = manager.comm_params.timeout_connect
        self.transport: asyncio.Transport | None = None
        self._answer: asyncio.Future[tuple[int, ...] | ModbusPDU] | None = None
        self._form: Form | None = None
        self._transaction = self._unit = 0
        self._in_pieces = self._silent = True
        self._due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self.transport is not None

    def begin(self) -> None:
        """Take the place of the library's end of its connection, which has just been made."""
        self.transport = cast("asyncio.Transport", self._manager.transport)
        self.transport.set_protocol(self)

    def ask(self, request: Request, unit: int, now_s: float) -> asyncio.Future[tuple[int, ...] | ModbusPDU]:
        """Send a request; return what becomes its answer: the words of the usual one, a message of the library else.

        `now_s` is the time on the event loop's clock, from which on the answer is waited for.

        Raises
        ------
        ConnectionException
            There is no connection. The future may fail with the exceptions of `execute`, an `UnreadableAnswerError`, or
            an `OSError`.
        """
        if self.transport is None:
            raise ConnectionException("not connected")
        transaction = self._transaction = self._transaction % LAST_TRANSACTION + 1
        self._unit = unit
        function, address, count, words = request
        form = self._form = form_of(function, unit, address, count)
        answer = self._answer = self.loop.create_future()
        if self._in_pieces:
            self._manager.recv_buffer, self._in_pieces = b"", False
        if form is None:
            self.transport.write(_by_library(request, unit, transaction))
        else:
            self.transport.write(form.request.pack(transaction, form.head, *words))
        self._due_s = now_s + self._timeout_s
        if self._timer is None:
            self._timer = self.loop.call_at(self._due_s, self._look)
        return answer

    def data_received(self, data: bytes) -> None:
        """Take bytes, in whatever pieces they come."""
        answer, form = self._answer, self._form
        if answer is None or answer.done():  # what comes now is late
            self._received_by_library(data)
            return
        usual = None if form is None or self._in_pieces else form.words_of(data, self._transaction)
        if usual is None:
            self._received_by_library(data)
        else:
            answer.set_result(usual)
            self._answer = None  # who waits has it: it goes while it is at hand, not at the next request
        if self._silent and answer.done():
            self._manager.count_until_disconnect, self._silent = self._manager.max_until_disconnect, False

    def _received_by_library(self, data: bytes) -> None:
        manager = self._manager
        manager.request_dev_id, manager.request_transaction_id = self._unit, self._transaction
        if self._answer is not None:
            manager.response_future = self._answer
        try:
            manager.data_received(data)
        except ModbusIOException as unreadable:  # let through, it would close the connection
            manager.recv_buffer = b""
            self._fail(UnreadableAnswerError(str(unreadable)))
        self._in_pieces = bool(manager.recv_buffer)

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note of a loss."""
        self.end()
        self._manager.connection_lost(exc)

    def end(self) -> None:
        """Let a request under way fail."""
        self.transport = None
        self._fail(ConnectionResetError("the connection was closed while the answer was awaited"))
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        """Look at the time limit of the request under way, if there is one."""
        self._timer = None
        if self._answer is None or self._answer.done():
            return
        if self.loop.time() < self._due_s:
            self._timer = self.loop.call_at(self._due_s, self._look)
            return
        self._fail(ModbusIOException("no answer within the time limit"))
        self._silent = True
        self._manager.count_until_disconnect -= 1
        if self._manager.count_until_disconnect < -1:
            self.connection_lost(TimeoutError("several requests in a row were not answered"))

    def _fail(self, reason: Exception) -> None:
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(reason)
            self._answer.exception()  # whoever waited may have been cancelled: then nobody else looks at it


def _by_library(request: Request, unit: int, transaction: int) -> bytes:
    message = request.pdu(unit)
    message.transaction_id = transaction
    return FRAMER.buildFrame(message)


class QuickClient(AsyncModbusTcpClient):
    """The library's client of TCP, with an `Exchange`."""

    def __init__(self, host: str, **parameters: Any) -> None:
        super().__init__(host, **parameters)
        self.exchange = Exchange(self.ctx)

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self.exchange.connected

    async def connect(self) -> bool:
        """Connect; return whether that succeeded."""
        made = await super().connect()
        if made and self.ctx.is_active():
            self.exchange.begin()
        return made

    def close(self) -> None:
        """Disconnect."""
        super().close()
        self.exchange.end()
