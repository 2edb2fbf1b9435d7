"""A simulated PLC: a `LoopDevice` served over Modbus.

Invariants: wire and clock only. The clock is the running event loop's, times `speed`; the physics is exact
at any polling rate of a client.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from autotuner_sim.devices import plc_registers

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from pymodbus.pdu import ModbusPDU
    from pymodbus.server.base import ModbusBaseServer

    from autotuner_sim.devices.loop_device import LoopDevice

IDLE_S = 0.5
"""The device is advanced at least this often, so that a request after an idle hour is answered at once."""


class SimulatedPlc:
    """The wire's view of a device: registers in, registers out.

    Parameters
    ----------
    device : LoopDevice
        What is served.
    speed : float
        Seconds of the plant per second of the clock.
    outer : LoopDevice, optional
        The outer loop of the device in a cascade, in manual: its output is the device's set point.
    """

    def __init__(self, device: LoopDevice, *, speed: float = 1.0, outer: LoopDevice | None = None) -> None:
        self.device, self.outer = device, outer
        self._speed = speed
        self._start_s = asyncio.get_running_loop().time()

    def advance(self) -> None:
        """Bring the device to the present."""
        (self.outer or self.device).advance((asyncio.get_running_loop().time() - self._start_s) * self._speed)

    async def run(self) -> None:
        """Keep the device near the present until cancelled."""
        while True:
            self.advance()
            await asyncio.sleep(IDLE_S)

    def unit(self, number: int = 0) -> SimDevice:
        """Return the device as unit `number` of a line; 0 answers to every number."""
        bit = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
        holding = [SimData(0, values=[0] * plc_registers.HOLDING_COUNT, datatype=DataType.REGISTERS)]
        inputs = [SimData(0, values=[0] * plc_registers.INPUT_COUNT, datatype=DataType.REGISTERS)]
        return SimDevice(number, simdata=(bit, bit, holding, inputs), action=self._on_request)

    async def _on_request(
        self,
        function_code: int,
        start_address: int,  # noqa: ARG002 - the library's signature
        address: int,
        count: int,  # noqa: ARG002 - the library's signature
        registers: list[int],
        values: Sequence[int] | Sequence[bool] | None,
    ) -> ExcCodes | None:
        """Write `values` to the device if there are any, and show its present state in `registers`."""
        self.advance()
        table = _TABLES[function_code]
        if values is not None and not self._write(table, address, values):
            return ExcCodes.ILLEGAL_VALUE
        words = self._words(table)
        registers[: len(words)] = words
        return None

    def _words(self, table: str) -> list[int]:
        return {
            "coil": [int(self.device.auto)],
            "discrete": [int(self.device.alarm)],
            "holding": plc_registers.holding_words(self.device),
            "input": plc_registers.input_words(self.device, self.outer),
        }[table]

    def _write(self, table: str, address: int, values: Sequence[int] | Sequence[bool]) -> bool:
        if table == "holding":
            return plc_registers.write_holding(self.device, address, [int(v) for v in values])
        if address == 0:
            self.device.auto = bool(values[0])
        return True


_TABLES = {1: "coil", 5: "coil", 15: "coil", 2: "discrete", 4: "input"} | dict.fromkeys((3, 6, 16, 22, 23), "holding")


@contextlib.asynccontextmanager
async def serving_tcp(plc: SimulatedPlc, host: str, port: int) -> AsyncIterator[int]:
    """Serve a PLC as a Modbus TCP slave within the context; port 0 selects a free port."""
    server = ModbusTcpServer(plc.unit(), address=(host, port))
    async with _serving(plc, server):
        listener: asyncio.Server = server.transport  # type: ignore[assignment]
        yield port or listener.sockets[0].getsockname()[1]


@contextlib.asynccontextmanager
async def serving_rtu(plc: SimulatedPlc, serial_port: str, unit: int) -> AsyncIterator[None]:
    """Serve a PLC as a Modbus RTU slave; it keeps silent when another unit is addressed."""

    def only_ours(sending: bool, message: ModbusPDU) -> ModbusPDU:  # noqa: FBT001 - the library's signature
        return message if sending or message.dev_id == unit else None  # type: ignore[return-value]

    async with _serving(plc, ModbusSerialServer(plc.unit(), port=serial_port, trace_pdu=only_ours)):
        yield


@contextlib.asynccontextmanager
async def _serving(plc: SimulatedPlc, server: ModbusBaseServer) -> AsyncIterator[None]:
    await server.serve_forever(background=True)
    keeper = asyncio.create_task(plc.run())
    try:
        yield
    finally:
        keeper.cancel()
        await asyncio.gather(keeper, return_exceptions=True)
        await server.shutdown()  # type: ignore[no-untyped-call]
