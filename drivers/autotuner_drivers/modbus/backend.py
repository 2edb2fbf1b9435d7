"""Driver `modbus`: a PLC or controller by Modbus TCP, TLS or RTU.

Options (table ``[loops.NAME.device]``), with their defaults::

    transport = "tcp"                # the kinds of lines, and the options of each, are in `modbus_lines`
    host = "192.168.1.10"            # required for TCP
    port = 502
    unit = 1
    timeout_s = 1.0                  # longest wait for a connection, and for an answer
    retries = 1                      # repetitions of a request that got no answer
    overlap = 4                      # most requests of a reading under way at once on a slow line (TCP, TLS; round
                                     # trip 50 ms and more; needs `retries`); 1: always one after another
    connection = "shared"            # loops with the same line, unit, times and limits share one connection and read in
                                     # common requests; "own": a separate connection
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

import asyncio
import contextlib
from typing import TYPE_CHECKING, Final

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner_drivers.modbus.lines import read_line
from autotuner_drivers.modbus.link import LINKS, LinkSettings, ModbusLink
from autotuner_drivers.modbus.protocol import READ_CODES, WRITE_CODES, Account, Request, read_request
from autotuner_drivers.modbus.register_map import HEARTBEAT, ReadRequest, read_map
from autotuner_drivers.options import Options, check_names

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from autotuner_drivers.modbus.register_map import Handshake, RegisterMap
    from autotuner_drivers.modbus.registers import Register

LONGEST_TIMEOUT_S: Final = 60.0
"""Longest time that may be set for an answer, s: gateways to radio lines take tens of seconds."""
OVERLAP: Final = 4
"""A reading of a loop has two to four requests; servers that keep to the guide take as many."""
MOST_OVERLAP: Final = 16
"""Most transactions of a server at once (Modbus Messaging on TCP/IP V1.0b, 4.4.1.2)."""
HANDSHAKE_S: Final = 5.0
"""Longest wait for a device to clear its handshake; programs of PLCs take some scans."""
HANDSHAKE_POLL_S: Final = 0.05
"""Time between two polls of a handshake, s: about one scan of a PLC."""


class ModbusBackend:
    """A loop behind a register map; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    link : ModbusLink
        The connection, where no other loop of the device has opened one.
    registers : RegisterMap
        Where the signals stand.
    """

    def __init__(self, link: ModbusLink, registers: RegisterMap) -> None:
        self._link, self._account = link, Account()
        self._gone: Callable[[str], None] | None = None
        self._map = registers
        self._beating = HEARTBEAT in registers.registers
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
        return self._account.moment_s

    @property
    def repeated(self) -> int:
        """How many requests were repeated since this was made."""
        return self._account.repeated

    def counted_from(self, now_s: float) -> float:
        """Return the origin of the periods of all loops of the device, s: see `autotuner.ports.LineSharing`."""
        return self._link.counted_from(now_s)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value that a signal's register can hold."""
        return self._map.registers[name].limits

    def resolution(self, name: str, value: float) -> float:
        """Return how finely a signal's register holds values around `value`: a read-back may differ by half of it."""
        return self._map.registers[name].resolution(value)

    def watch(self, gone: Callable[[str], None] | None) -> None:
        """Call `gone` with the reason as soon as the device has closed the connection and takes no new one."""
        self._gone = gone
        if self._account in self._link.users:
            self._link.users[self._account] = gone

    def only_read(self) -> None:
        """Write nothing by itself from now on: no heartbeat."""
        self._beating = False

    async def open(self) -> None:
        """Connect, unless another loop of the device is; raise `LinkError` when the device cannot be reached."""
        if self._account not in self._link.users:
            self._link = LINKS.join(self._account, self._link, self._gone)
            try:
                self._link.take_line()
            except LinkError:
                await LINKS.leave(self._account, self._link)
                raise
        await self._link.open()

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, in as few requests as the map and the device allow."""
        plan = self._plan(names)
        beat = [await self._beat()] if self._beating else []
        answers = await self._link.ask_all([*beat, *(request for request, _ in plan)], self._account)
        values: dict[str, float] = {}
        for (_, decode), words in zip(plan, answers[len(beat) :], strict=True):
            values |= decode(words)
        return values

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given, one request each; a value that does not fit stops before any."""
        check_names(values, self.writable, "write")
        for name, value in values.items():
            self._map.registers[name].encode(value)
        blocks = [group for group in self._map.together if set(group) & values.keys()]
        for group in blocks:
            await self._write_block(group, values)
        for name in values:
            if not any(name in group for group in blocks):
                await self._set(self._map.registers[name], values[name])
        if self._map.handshake is not None and self._map.handshake.signals & values.keys():
            await self._shake_hands(self._map.handshake)

    async def close(self) -> None:
        """Disconnect, unless another loop needs it; announce first that no more beats will come, if the PLC listens."""
        if self._beats and self._link.connected:
            with contextlib.suppress(DriverError):
                await self._set(self._map.registers[HEARTBEAT], 0.0)
        self._beats = 0
        await LINKS.leave(self._account, self._link)

    def _plan(self, names: Collection[str]) -> list[tuple[Request, Callable[[Sequence[int]], dict[str, float]]]]:
        """Return the requests that read the named signals, with what decodes their answers; made once."""
        key = tuple(names)
        if key not in self._plans:
            check_names(names, self.readable, "read")
            self._plans[key] = [(read_request(read), read.decoder()) for read in self._map.reads(names)]
        return self._plans[key]

    async def _beat(self) -> Request:
        """Count up, from the highest number to 1; a coil or a bit toggles."""
        self._beats += 1
        register = self._map.registers[HEARTBEAT]
        most = int(register.limits[1])
        return await self._write(register, float((self._beats - 1) % most + 1 if most > 1 else self._beats % 2))

    async def _ask(self, request: Request) -> tuple[int, ...]:
        return await self._link.ask(request, self._account)

    async def _set(self, register: Register, value: float) -> None:
        """Write a signal."""
        await self._ask(await self._write(register, value))

    async def _write(self, register: Register, value: float) -> Request:
        """Return the request that writes a signal, a bit of its word as it is now, or the pulse that sets it."""
        if register.pulses is not None:
            register.encode(value)
            register, value = register.pulses[int(value)], 1.0
        target = register.target
        words = target.encode(value)
        if target.bit is not None:
            (word,) = await self._ask(Request(READ_CODES[target.table], target.address, 1, unit=target.unit))
            words = (target.merged(word, words[0]),)
        function = WRITE_CODES[target.table, self._map.limits.single(target)]
        return Request(function, target.address, len(words), words, target.unit)

    async def _write_block(self, group: Sequence[str], values: Mapping[str, float]) -> None:
        """Write signals that the device takes only together, those that were not named as they are, in one request."""
        missing = [name for name in group if name not in values]
        held = dict(values) | (await self.read(missing) if missing else {})
        registers = [self._map.registers[name].target for name in group]
        words = tuple(word for r, name in zip(registers, group, strict=True) for word in r.encode(held[name]))
        first = registers[0]
        await self._ask(Request(WRITE_CODES["holding", False], first.address, len(words), words, first.unit))

    async def _shake_hands(self, handshake: Handshake) -> None:
        """Set the bit that makes the device take new values, and wait until the device clears it."""
        register = handshake.register
        await self._set(register, 1.0)
        read = read_request(ReadRequest(register.table, register.address, register.size, (register,), register.unit))
        try:
            async with asyncio.timeout(HANDSHAKE_S):
                while register.decode(await self._ask(read)) != 0.0:  # noqa: ASYNC110 - a device only answers
                    await asyncio.sleep(HANDSHAKE_POLL_S)
        except TimeoutError as error:
            raise DeviceRefusedError(
                f"the device has not cleared the handshake at {register.place} within {HANDSHAKE_S:g} s",
                field="handshake",
                remedy="Check the bit, and whether the device's program takes new values in this mode.",
            ) from error


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
    overlap = table.integer("overlap", OVERLAP, low=1, high=MOST_OVERLAP)
    own = table.choice("connection", ("shared", "own"), "shared") == "own"
    table.done()
    settings = LinkSettings(unit, timeout_s, retries, overlap, registers.limits)
    return ModbusBackend(ModbusLink(line, settings, own=own), registers)
