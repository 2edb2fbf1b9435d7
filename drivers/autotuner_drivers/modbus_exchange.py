"""Requests and answers of Modbus TCP and TLS through the library, without what its `execute` spends on each of them.

`execute` takes a lock, a task, a timer and two message objects a request. Here a request is one future; one timer
looks at the time limits of many requests, and the usual answer is known by its bytes (`modbus_forms`).

Rules of this file:

1. One request at a time: whoever uses a client takes turns.
2. An answer is taken by its bytes only when it came whole, alone and just as it should, with its transaction and unit.
   Everything else goes the library's way, which joins pieces, passes over what belongs to another request, and decodes.
3. A request ends with an answer, at its time limit, or with the connection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException
from pymodbus.transaction import TransactionManager

from autotuner_drivers.modbus_forms import form_of

if TYPE_CHECKING:
    import asyncio

    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.modbus_forms import Form
    from autotuner_drivers.modbus_requests import Request


class Exchange(TransactionManager):
    """The library's end of one connection; what is not overridden here is as it was."""

    _form: Form | None = None
    _transaction = b""
    _due_s = 0.0
    _timer: asyncio.TimerHandle | None = None

    def ask(self, request: Request, unit: int, now_s: float) -> asyncio.Future[tuple[int, ...] | ModbusPDU]:
        """Send a request; return what becomes its answer: the words of the usual one, a message of the library else.

        `now_s` is the time on the event loop's clock, from which on the answer is waited for.

        Raises
        ------
        ConnectionException
            There is no connection. The future may fail with the exceptions of `execute`, or with an `OSError`.
        """
        if not self.is_active():
            raise ConnectionException("not connected")
        self.request_dev_id, self.request_transaction_id = unit, self.getNextTID()
        self._form = form_of(request.function, unit, request.address, request.count)
        self._transaction = self.request_transaction_id.to_bytes(2, "big")
        self.recv_buffer = b""
        self.response_future = self.loop.create_future()
        self.transport.write(self._frame(request, unit))  # type: ignore[attr-defined]  # as the library does
        self._due_s = now_s + self.comm_params.timeout_connect
        if self._timer is None:
            self._timer = self.loop.call_at(self._due_s, self._look)
        return self.response_future

    def _frame(self, request: Request, unit: int) -> bytes:
        if self._form is not None:
            return self._form.request(self._transaction, request.words)
        message = request.pdu(unit)
        message.transaction_id = self.request_transaction_id
        return self.framer.buildFrame(message)

    def data_received(self, data: bytes) -> None:
        """Take bytes, in whatever pieces they come."""
        answer = self.response_future
        if answer.done():  # what comes now is late
            super().data_received(data)
            return
        usual = None if self._form is None or self.recv_buffer else self._form.words_of(data, self._transaction)
        if usual is None:
            super().data_received(data)
        else:
            answer.set_result(usual)
        if answer.done():
            self.count_until_disconnect = self.max_until_disconnect

    def callback_disconnected(self, exc: Exception | None) -> None:
        """Take note of a loss."""
        self._end()
        super().callback_disconnected(exc)

    def close(self, reconnect: bool = False) -> None:  # noqa: FBT001, FBT002 - the library's signature
        """Disconnect."""
        super().close(reconnect)
        self._end()

    def _look(self) -> None:
        """Look at the time limit of the request under way, if there is one."""
        self._timer = None
        if self.response_future.done():
            return
        if self.loop.time() < self._due_s:
            self._timer = self.loop.call_at(self._due_s, self._look)
            return
        self._fail(ModbusIOException("no answer within the time limit"))
        self.count_until_disconnect -= 1
        if self.count_until_disconnect < -1:
            self.connection_lost(TimeoutError("several requests in a row were not answered"))

    def _end(self) -> None:
        self._fail(ConnectionResetError("the connection was closed while the answer was awaited"))
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _fail(self, reason: Exception) -> None:
        if not self.response_future.done():
            self.response_future.set_exception(reason)
            self.response_future.exception()  # whoever waited may have been cancelled: then nobody else looks at it


class QuickClient(AsyncModbusTcpClient):
    """The library's client of TCP, with an `Exchange`."""

    def __init__(self, host: str, **parameters: Any) -> None:
        super().__init__(host, **parameters)
        usual = self.ctx
        self.ctx: Exchange = Exchange(
            self.comm_params,
            usual.framer,
            usual.retries,
            is_server=False,
            trace_packet=usual.trace_packet,
            trace_pdu=None,
            trace_connect=usual.trace_connect,
        )
