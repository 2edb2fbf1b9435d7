"""Driver `modbus`: a PLC or controller by Modbus TCP.

Options (table ``[loops.NAME.device]``), with their defaults::

    host = "192.168.1.10"            # required
    port = 502
    unit = 1
    timeout_s = 1.0                  # longest wait for a connection, and for an answer
    retries = 1                      # repetitions of a request that got no answer
    max_registers_per_read = 125     # limits of the device, see `register_map.DeviceLimits`
    max_bits_per_read = 2000
    max_gap = 0
    use_fc5 = true
    use_fc6 = true
    use_fc16 = true
    odd_addresses = false
    word_order = "big"               # "little": low word first; also per register
    byte_order = "big"

    [loops.NAME.device.registers]    # pv and output are required; see `registers.Register`
    pv = { table = "input", address = 0, type = "int16", scale = 0.1, invalid = [32767] }
    output = { table = "holding", address = 0, type = "int16", scale = 0.1 }
    set_point = { table = "holding", address = 1, type = "int16", scale = 0.1 }
    auto = { table = "coil", address = 0 }     # or an integer register with auto_value and manual_value

Any further name (`kp`, `heartbeat`, ...) is one more signal that can be read, and written where its table allows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pymodbus.client import AsyncModbusTcpClient

from autotuner_drivers.modbus_link import LinkSettings, ModbusLink
from autotuner_drivers.options import Options
from autotuner_drivers.register_map import read_map
from autotuner_drivers.signals import check_names

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from autotuner_drivers.register_map import RegisterMap

LONGEST_TIMEOUT_S = 60.0


class ModbusBackend:
    """A loop behind a register map; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    link : ModbusLink
        The connection.
    registers : RegisterMap
        Where the signals stand.
    """

    def __init__(self, link: ModbusLink, registers: RegisterMap) -> None:
        self._link = link
        self._map = registers

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals of the map."""
        return self._map.readable

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals in tables that can be written, without the PV."""
        return self._map.writable

    async def open(self) -> None:
        """Connect; raise `LinkError` when the device cannot be reached."""
        await self._link.open()

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, in as few requests as the map and the device allow."""
        check_names(names, self.readable, "read")
        values: dict[str, float] = {}
        for request in self._map.reads(names):
            values |= request.decode(await self._link.read(request))
        return values

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given, one request each; a value that does not fit stops before any."""
        check_names(values, self.writable, "write")
        for register, words in [(self._map.registers[name], self._encoded(name, values[name])) for name in values]:
            await self._link.write(register.table, register.address, words, single=self._map.limits.single(register))

    async def close(self) -> None:
        """Disconnect."""
        self._link.close()

    def _encoded(self, name: str, value: float) -> tuple[int, ...]:
        return self._map.registers[name].encode(value)


@dataclass(frozen=True, slots=True)
class TcpLine:
    """Modbus TCP."""

    host: str
    port: int

    @property
    def label(self) -> str:
        """The device's address, for messages."""
        return f"{self.host}:{self.port}"

    def client(self, timeout_s: float, on_connection: Callable[[bool], None]) -> AsyncModbusTcpClient:
        """Return a client that neither repeats nor reconnects by itself."""
        return AsyncModbusTcpClient(
            self.host,
            port=self.port,
            timeout=timeout_s,
            retries=0,
            reconnect_delay=0,
            trace_connect=on_connection,
        )


def create(options: Mapping[str, object]) -> ModbusBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    registers = read_map(table)
    line = TcpLine(table.text("host"), table.integer("port", 502, low=1, high=65535))
    settings = LinkSettings(
        unit=table.integer("unit", 1, low=0, high=255),
        timeout_s=table.number("timeout_s", 1.0, low=0.01, high=LONGEST_TIMEOUT_S, unit="s"),
        retries=table.integer("retries", 1, low=0, high=10),
    )
    table.done()
    return ModbusBackend(ModbusLink(line, settings), registers)
