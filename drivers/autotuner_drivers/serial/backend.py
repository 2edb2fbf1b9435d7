"""Driver `serial`: a controller or board on a serial line with its own protocol.

Options (table ``[loops.NAME.device]``), with their defaults::

    protocol = "tclab"               # required: tclab, lakeshore, eurotherm, or template (the user's own)
    serial_port = "/dev/ttyACM0"     # required
    baudrate = 115200                # baudrate, bytesize, parity: defaults of the protocol
    bytesize = 8
    parity = "N"
    stopbits = 1
    timeout_s = 1.0                  # longest wait for an answer
    retries = 2                      # repetitions of the reading, or the setting, of a signal that failed
    late_answer_s = 1.0              # how long after timeout_s a late answer is awaited; default timeout_s
    gap_s = 0.05                     # silence that ends a message
    echo = false                     # true: a two-wire adapter sends back what is sent

The protocols' own options are described in `tclab`, `lakeshore`, `bisynch` and `template_protocol`.

`volatile_output` marks a device that drops its output after a command damaged on the line. The driver then sets the
output again before it repeats the command, and checks the output with every reading. An output that changed without
such a command is an error and is not set again.

Loops on one port, such as the two channels of a board, share the port within one event loop (`open_line`). A damaged
command may affect all of them, so each sets its output again before its next command.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import OUTPUT, PV
from autotuner_drivers.links import GarbledAnswerError
from autotuner_drivers.options import Options, check_finite, check_names
from autotuner_drivers.serial.bisynch import read_bisynch
from autotuner_drivers.serial.lakeshore import read_lakeshore
from autotuner_drivers.serial.link import SerialLink, Timing
from autotuner_drivers.serial.open_line import PORTS, Frame, OpenLine
from autotuner_drivers.serial.port import SerialThread, read_serial
from autotuner_drivers.serial.protocol import DeniedError, Stepped
from autotuner_drivers.serial.tclab import read_tclab
from autotuner_drivers.serial.template import read_template

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Mapping

    from autotuner_drivers.serial.protocol import LineProtocol, Steps

REPEATED: Final = (DeviceTimeoutError, GarbledAnswerError, DeniedError)
"""Errors that a disturbed line can cause; the command is repeated."""
SAME_OUTPUT: Final = 0.01
"""Largest difference between set and reported output, output units: boards with a volatile output report 0.01."""


class SerialBackend:
    """A loop on a serial line; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    link : SerialLink
        The line.
    protocol : LineProtocol
            Commands and answers of the device.
        retries : int
            Repetitions of a failed reading or write.
        frame : Frame, optional
            Settings that loops on a shared line must agree on; None: the line is not shared.
    """

    def __init__(self, link: SerialLink, protocol: LineProtocol, retries: int, frame: Frame | None = None) -> None:
        self._protocol, self._retries = protocol, retries
        self._own = self._line = OpenLine(link, frame)
        self._opened = False
        self._entered = 0
        self._found: float | None = None
        self._output: float | None = None
        self._in_doubt = False
        self._moment_s = self._acted_s = math.nan
        self.repeated = 0

    @property
    def _link(self) -> SerialLink:
        return self._line.link

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that the protocol can read."""
        return self._protocol.readable

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that the protocol can write."""
        return self._protocol.writable

    @property
    def opening_disturbs(self) -> bool:
        """Whether opening the port resets the device; such a port should not be opened for a reading alone."""
        return self._protocol.settle_s > 0.0

    @property
    def latency_s(self) -> float:
        """Median time from a command to its answer, s."""
        return self._link.latency_s

    @property
    def moment_s(self) -> float:
        """Time of the exchange that last read the PV or set a signal, on the event loop's clock, s."""
        return self._moment_s

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value of a signal; infinite where the protocol has no limit."""
        return self._protocol.ranges.get(name, (-math.inf, math.inf))

    def resolution(self, name: str, value: float) -> float:  # noqa: ARG002 - it does not depend on the value
        """Return the resolution of the values that are sent; 0 where unknown."""
        return self._protocol.step(name) if isinstance(self._protocol, Stepped) else 0.0

    async def open(self) -> None:
        """Open the port, or join a loop that has it open, and enter the protocol."""
        if self not in self._line.users:
            self._line = PORTS.join(self, self._own, self._doubt)
        async with self._line.turn:
            self._opened = True
            await self._connect(at_once=True)

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, one by one; the PV is read last, nearest to the next write."""
        check_names(names, self.readable, "read")
        in_order = sorted(names, key=lambda name: name == PV)
        async with self._line.turn:
            values = {name: await self._persistent(partial(self._protocol.read, name)) for name in in_order}
            self._moment_s = self._link.moment_s
            checked = await self._checked_output(values.get(OUTPUT))
        return values if OUTPUT not in values else values | {OUTPUT: checked}

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the given order; confirm each as far as the device allows."""
        check_names(values, self.writable, "write")
        check_finite(values)
        async with self._line.turn:
            for name, value in values.items():
                if name == OUTPUT:
                    await self._write_output(value)
                else:
                    await self._persistent(partial(self._protocol.write, name, value))
                self._moment_s = self._acted_s  # the later exchanges only confirm it

    async def close(self) -> None:
        """Close the port, unless another loop uses it.

        Settings other than the signals that writing has changed are restored first, if the device still answers.
        """
        self._opened = False
        line = self._line
        async with line.turn:
            if line.link.connected and self._found is not None:
                with contextlib.suppress(DriverError):
                    await self._run(self._protocol.leave(self._found))
            self._found = self._output = None
            await PORTS.leave(self, line)
            self._line, self._entered = self._own, 0

    async def _write_output(self, value: float) -> None:
        """Set the output; from then on it is the value that the device must hold, even after an error."""
        self._output = None
        try:
            await self._persistent(partial(self._protocol.write, OUTPUT, value))
        finally:
            self._output = value

    async def _checked_output(self, held: float | None) -> float:
        """Return the output; raise `DeviceRefusedError` when the device has changed it, perhaps by a safety cut-out.

        A different value is read a second time before the error, because one damaged digit is a valid number too.
        """
        if self._output is None or not (self._protocol.volatile_output and OUTPUT in self.readable):
            return math.nan if held is None else held
        for reading in (held, None):
            present = await self._persistent(partial(self._protocol.read, OUTPUT)) if reading is None else reading
            if abs(present - self._output) <= SAME_OUTPUT:
                return present
        raise DeviceRefusedError(
            f"the device has changed its output: it holds {present:g} where {self._output:g} was set",
            field=OUTPUT,
            value=present,
            remedy="Check the device: it may have switched off for its own safety.",
        )

    async def _persistent(self, steps: Callable[[], Steps]) -> float:
        """Run steps, and repeat them after an error of the line."""
        return await self._repeated(lambda: self._attempt(steps))

    async def _attempt(self, steps: Callable[[], Steps]) -> float:
        if not self._opened:
            raise LinkError("the serial line is not open", remedy="Open the backend first.")
        await self._connect()
        try:
            if self._in_doubt and self._output is not None:
                await self._run(self._protocol.write(OUTPUT, self._output))
            self._in_doubt = False
            return await self._run(steps())
        except DriverError:
            self._line.doubt()
            raise

    def _doubt(self) -> None:
        """Record that the device may have dropped the output."""
        self._in_doubt = self._protocol.volatile_output

    async def _connect(self, *, at_once: bool = False) -> None:
        """Connect and enter the protocol, where needed.

        The values found on the first connection are the values restored at the end.
        """
        line = self._line
        connected = line.link.connected
        if connected and self._entered == line.connections:
            return
        if not connected:
            await line.link.connect(at_once=at_once)
            line.connections += 1
        self._doubt()
        try:
            if not connected:
                await line.link.settle(self._protocol.settle_s)
            found = await self._repeated(lambda: self._run(self._protocol.enter()))
        except BaseException:
            if not connected:
                await line.link.disconnect()
            raise
        self._entered = line.connections
        self._found = found if self._found is None else self._found

    async def _repeated(self, attempt: Callable[[], Awaitable[float]]) -> float:
        for _ in range(self._retries):
            try:
                return await attempt()
            except REPEATED:
                self.repeated += 1
        return await attempt()

    async def _run(self, steps: Steps) -> float:
        self._acted_s = math.nan
        try:
            exchange = next(steps)
            while True:
                answer = await self._link.exchange(exchange)
                if exchange.acts or math.isnan(self._acted_s):
                    self._acted_s = self._link.moment_s
                exchange = steps.send(answer)
        except StopIteration as end:
            return float(end.value)


@dataclass(frozen=True, slots=True)
class ProtocolDefaults:
    """Parser of a protocol's options, and its default frame."""

    read: Callable[[Options], LineProtocol]
    baudrate: int
    bytesize: int = 8
    parity: str = "N"


PROTOCOLS: Final[dict[str, ProtocolDefaults]] = {
    "tclab": ProtocolDefaults(read_tclab, 115200),
    "lakeshore": ProtocolDefaults(read_lakeshore, 57600, 7, "O"),
    "eurotherm": ProtocolDefaults(read_bisynch, 9600, 7, "E"),
    "template": ProtocolDefaults(read_template, 9600),
}


def create(options: Mapping[str, object]) -> SerialBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been opened.
    """
    table = Options(options)
    protocol_name = table.choice("protocol", tuple(PROTOCOLS))
    usual = PROTOCOLS[protocol_name]
    protocol = usual.read(table)
    settings = read_serial(table, baudrate=usual.baudrate, bytesize=usual.bytesize, parity=usual.parity)
    timeout_s = table.number("timeout_s", 1.0, low=0.01, high=60.0, unit="s")
    timing = Timing(
        timeout_s,
        table.number("late_answer_s", timeout_s, low=0.0, high=60.0, unit="s"),
        table.number("gap_s", 0.05, low=0.001, high=1.0, unit="s"),
        protocol.pause_s,
        table.flag("echo", default=False),
    )
    retries = table.integer("retries", 2, low=0, high=10)
    table.done()
    link = SerialLink(SerialThread(settings), settings.port, timing, protocol.split)
    return SerialBackend(link, protocol, retries, Frame(settings, protocol_name, timing))
