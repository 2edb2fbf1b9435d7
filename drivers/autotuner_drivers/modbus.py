"""Driver `modbus`: a PLC or controller by Modbus TCP, TLS or RTU.

Options (table ``[loops.NAME.device]``), with their defaults::

    transport = "tcp"                # the kinds of lines, and the options of each, are in `modbus_lines`
    host = "192.168.1.10"            # required for TCP
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

    heartbeat = { table = "holding", address = 2, type = "uint16" }

Every read counts `heartbeat` up by one, and closing sets it to 0, so that the PLC's own watchdog can take over when the
beats stop; it counts only as long as the loop is really being driven. Any further name (`kp`, ...) is one more signal
that can be read, and written where its table allows it.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final

from autotuner.errors import DriverError
from autotuner_drivers.modbus_lines import read_line
from autotuner_drivers.modbus_link import LinkSettings, ModbusLink
from autotuner_drivers.modbus_requests import WRITE_CODES, Request, read_request
from autotuner_drivers.options import Options
from autotuner_drivers.register_map import HEARTBEAT, read_map
from autotuner_drivers.signals import check_names

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from autotuner_drivers.register_map import RegisterMap

LONGEST_TIMEOUT_S: Final = 60.0


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
        self._writes = {
            name: (register, WRITE_CODES[register.table, registers.limits.single(register)])
            for name, register in registers.registers.items()
            if name in registers.writable or name == HEARTBEAT
        }
        self._beating = HEARTBEAT in self._writes
        self._beats = 0
        self._plans: dict[tuple[str, ...], list[tuple[Request, Callable[[Sequence[int]], dict[str, float]]]]] = {}

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals of the map."""
        return self._map.readable

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals in tables that can be written, without the PV."""
        return self._map.writable

    @property
    def latency_s(self) -> float:
        """Median time from a request to its answer, s."""
        return self._link.latency_s

    @property
    def moment_s(self) -> float:
        """Time, on the event loop's clock, in the middle of the last exchange, which reads the PV or writes, s.

        Half of the round trip before the answer: on a line as slow in one direction as in the other, when the device
        answered. Repetitions before it do not count.
        """
        return self._link.moment_s

    @property
    def repeated(self) -> int:
        """How many requests were repeated since this was made."""
        return self._link.repeated

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value that a signal's register can hold."""
        return self._map.registers[name].limits

    def resolution(self, name: str, value: float) -> float:
        """Return how finely a signal's register holds values around `value`: a read-back may differ by half of it."""
        return self._map.registers[name].resolution(value)

    def watch(self, gone: Callable[[str], None] | None) -> None:
        """Call `gone` with the reason as soon as the device has closed the connection and takes no new one."""
        self._link.watch(gone)

    async def open(self) -> None:
        """Connect; raise `LinkError` when the device cannot be reached."""
        await self._link.open()

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, in as few requests as the map and the device allow."""
        plan = self._plan(names)
        if self._beating:
            await self._beat()
        values: dict[str, float] = {}
        for asked, decode in plan:
            values |= decode(await self._link.ask(asked))
        return values

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given, one request each; a value that does not fit stops before any."""
        if HEARTBEAT in values or not values.keys() <= self._writes.keys():
            check_names(values, self.writable, "write")
        for request in [self._request(name, value) for name, value in values.items()]:
            await self._link.ask(request)

    async def close(self) -> None:
        """Disconnect; tell the PLC first that no more beats will come, if it still listens."""
        if self._beats and self._link.connected:
            with contextlib.suppress(DriverError):
                await self._link.ask(self._request(HEARTBEAT, 0.0))
        self._beats = 0
        await self._link.close()

    def _plan(self, names: Collection[str]) -> list[tuple[Request, Callable[[Sequence[int]], dict[str, float]]]]:
        """Return the requests that read the named signals, with what decodes their answers; made once."""
        key = tuple(names)
        if key not in self._plans:
            check_names(names, self.readable, "read")
            self._plans[key] = [(read_request(read), read.decoder()) for read in self._map.reads(names)]
        return self._plans[key]

    async def _beat(self) -> None:
        self._beats = self._beats % int(self._map.registers[HEARTBEAT].limits[1]) + 1
        await self._link.ask(self._request(HEARTBEAT, float(self._beats)))

    def _request(self, name: str, value: float) -> Request:
        register, function = self._writes[name]
        words = register.encode(value)
        return Request(function, register.address, len(words), words)


def create(options: Mapping[str, object]) -> ModbusBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    registers = read_map(table)
    timeout_s = table.number("timeout_s", 1.0, low=0.01, high=LONGEST_TIMEOUT_S, unit="s")
    line, unit = read_line(table, timeout_s)
    retries = table.integer("retries", 1, low=0, high=10)
    table.done()
    return ModbusBackend(ModbusLink(line, LinkSettings(unit, timeout_s, retries)), registers)
