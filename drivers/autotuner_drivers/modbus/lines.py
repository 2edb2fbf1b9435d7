"""Kinds of Modbus lines: TCP, TLS, RTU and ASCII on a serial port or through a transparent gateway.

Options, beside `transport` = "tcp" (default), "tls", "rtu", "rtu_over_tcp", "ascii" or "ascii_over_tcp"::

    host, port                           # all but "rtu"; port 502, and 802 for TLS
    ca_file, cert_file, key_file         # "tls": who signed the device's certificate; our own certificate and key
    server_name = "plc.example"          # "tls": the name in the device's certificate, when it is not `host`
    serial_port = "/dev/ttyUSB0"         # "rtu"
    baudrate = 19200                     # "rtu"
    parity = "E"                         # "rtu": N, E or O
    stopbits = 1                         # "rtu"
    echo = false                         # both RTU: a two-wire adapter sends back what is sent
    late_answer_s = 0.5                  # both RTU: after the time limit, an answer may still arrive for so long;
                                         # default timeout_s, and 0.5 at least
    gap_s = 0.05                         # both RTU: silence that ends a message
    pause_s = 0.005                      # both RTU: silence between an answer and the next request
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.framer import FramerType
from pymodbus.transport import CommParams, CommType

from autotuner_drivers.modbus.line_watch import LineSettings
from autotuner_drivers.options import read_tls
from autotuner_drivers.serial.port import SerialSettings, read_serial

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Coroutine

    from pymodbus.client.base import ModbusBaseClient

    from autotuner_drivers.options import Options

LONGEST_LATENESS_S: Final = 60.0
"""Largest lateness of an answer that may be set, s: the longest time for an answer."""
SLAVE_GIVES_UP_S: Final = 0.5
"""A slave that got a damaged request may wait for its rest, and takes the next request for it; libmodbus so long."""
RTU_LAST_UNIT: Final = 247
"""Highest address of a slave on a serial line (Modbus over Serial Line V1.02, section 2.2)."""


@dataclass(frozen=True, slots=True)
class Hooks:
    """What a client reports: each change of its connection, and each packet (sent or received)."""

    on_connection: Callable[[bool], None]
    on_packet: Callable[[bool, bytes], bytes]

    def arguments(self, timeout_s: float) -> dict[str, Any]:
        """Return the arguments of a client that neither repeats nor reconnects by itself."""
        return {
            "timeout": timeout_s,
            "retries": 0,
            "reconnect_delay": 0,
            "trace_connect": self.on_connection,
            "trace_packet": self.on_packet,
        }


class Line(Protocol):
    """The kind of line."""

    @property
    def label(self) -> str:
        """The device's address, for messages."""

    @property
    def watch(self) -> LineSettings | None:
        """Timing of a line whose answers carry no number; None when they do."""

    def client(self, timeout_s: float, hooks: Hooks) -> ModbusBaseClient:
        """Return a client that is not yet connected."""


@dataclass(frozen=True, slots=True)
class TcpLine:
    """Modbus TCP, or RTU or ASCII frames over TCP when it has a `watch`."""

    host: str
    port: int
    watch: LineSettings | None = None

    @property
    def label(self) -> str:
        """The device's address, for messages."""
        return f"{self.host}:{self.port}"

    def client(self, timeout_s: float, hooks: Hooks) -> ModbusBaseClient:
        """Return a client that is not yet connected."""
        arguments = hooks.arguments(timeout_s)
        framer = _framer(self.watch) if self.watch else FramerType.SOCKET
        return AsyncModbusTcpClient(self.host, port=self.port, framer=framer, **arguments)


@dataclass(frozen=True, slots=True)
class TlsLine:
    """Modbus TCP within TLS, with the header of Modbus TCP (MODBUS/TCP Security Protocol Specification, 2018)."""

    host: str
    port: int
    context: ssl.SSLContext
    server_name: str
    watch: None = None

    @property
    def label(self) -> str:
        """The device's address, for messages."""
        return f"{self.host}:{self.port}"

    def client(self, timeout_s: float, hooks: Hooks) -> ModbusBaseClient:
        """Return a client that is not yet connected."""
        client = _TlsClient(self, timeout_s, hooks)
        create: Callable[..., Coroutine[Any, Any, Any]] = client.ctx.call_create
        client.ctx.call_create = partial(create, server_hostname=self.server_name)
        return client


class _TlsClient(AsyncModbusTcpClient):
    """The library's TLS client decodes only whole answers in one piece; this one takes the framer of TCP."""

    def __init__(self, line: TlsLine, timeout_s: float, hooks: Hooks) -> None:
        self.comm_params = CommParams(
            comm_type=CommType.TLS,
            host=line.host,
            port=line.port,
            sslctx=line.context,
            reconnect_delay=0,
            timeout_connect=timeout_s,
        )
        super().__init__(line.host, **hooks.arguments(timeout_s))


@dataclass(frozen=True, slots=True)
class RtuLine:
    """Modbus RTU or ASCII on a serial port."""

    serial: SerialSettings
    watch: LineSettings

    @property
    def label(self) -> str:
        """The port, for messages."""
        return self.serial.port

    def client(self, timeout_s: float, hooks: Hooks) -> ModbusBaseClient:
        """Return a client that is not yet connected."""
        framer = _framer(self.watch)
        return AsyncModbusSerialClient(
            self.serial.port, framer=framer, **self.serial.arguments(), **hooks.arguments(timeout_s)
        )


def _framer(watch: LineSettings) -> FramerType:
    return FramerType.ASCII if watch.text else FramerType.RTU


def read_line(options: Options, timeout_s: float) -> tuple[Line, int]:
    """Take the line and the unit number out of the driver's options.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy.
    """
    transport = options.choice("transport", tuple(_READERS), "tcp")
    low, high = (1, RTU_LAST_UNIT) if transport.startswith(("rtu", "ascii")) else (0, 255)
    return _READERS[transport](options, timeout_s), options.integer("unit", 1, low=low, high=high)


def _read_tcp(options: Options, timeout_s: float) -> Line:  # noqa: ARG001 - the signature of all readers
    return TcpLine(options.text("host"), _port(options, 502))


def _read_rtu_over_tcp(options: Options, timeout_s: float) -> Line:
    return TcpLine(options.text("host"), _port(options, 502), _watch(options, timeout_s))


def _read_rtu(options: Options, timeout_s: float) -> Line:
    return RtuLine(read_serial(options, baudrate=19200, parity="E", bytesizes=(8,)), _watch(options, timeout_s))


def _read_ascii(options: Options, timeout_s: float) -> Line:
    serial = read_serial(options, baudrate=9600, parity="E", bytesize=7)
    return RtuLine(serial, replace(_watch(options, timeout_s), text=True))


def _read_ascii_over_tcp(options: Options, timeout_s: float) -> Line:
    return TcpLine(options.text("host"), _port(options, 502), replace(_watch(options, timeout_s), text=True))


def _read_tls(options: Options, timeout_s: float) -> Line:  # noqa: ARG001 - the signature of all readers
    host = options.text("host")
    return TlsLine(host, _port(options, 802), read_tls(options), options.text("server_name", host))


def _watch(options: Options, timeout_s: float) -> LineSettings:
    max_lateness_s = options.number(
        "late_answer_s", max(timeout_s, SLAVE_GIVES_UP_S), low=0.0, high=LONGEST_LATENESS_S, unit="s"
    )
    return LineSettings(
        patience_s=timeout_s + max_lateness_s,
        gap_s=options.number("gap_s", 0.05, low=0.001, high=1.0, unit="s"),
        pause_s=options.number("pause_s", 0.005, low=0.0, high=1.0, unit="s"),
        echo=options.flag("echo", default=False),
    )


def _port(options: Options, default: int) -> int:
    return options.integer("port", default, low=1, high=65535)


_READERS: Final[dict[str, Callable[[Options, float], Line]]] = {
    "tcp": _read_tcp,
    "tls": _read_tls,
    "rtu": _read_rtu,
    "rtu_over_tcp": _read_rtu_over_tcp,
    "ascii": _read_ascii,
    "ascii_over_tcp": _read_ascii_over_tcp,
}
