"""Driver `s7`: variables of a Siemens S7 controller by the S7 protocol (extra `s7`, package python-snap7).

Options (table ``[loops.NAME.device]``), with their defaults::

    host = "192.168.0.1"             # required
    port = 102
    rack = 0
    slot = 1                         # 1 for S7-1200 and 1500, 2 for S7-300
    timeout_s = 3.0                  # longest wait for a connection, and for an answer

    [loops.NAME.device.variables]    # pv and output are required
    pv = { db = 10, byte = 0, type = "real" }
    output = { db = 10, byte = 4, type = "real" }
    set_point = { area = "merker", byte = 20, type = "int", scale = 0.1 }
    auto = { db = 10, byte = 8, bit = 0 }        # bool; or an integer with auto_value and manual_value

`type` is bool, byte, int, word, dint, dword, real or lreal; `area` is db (default), merker, input or output. The PLC
must permit PUT/GET access, and the data block must not be optimised; otherwise the PLC refuses with an error.

Invariants: the library blocks, so its calls run in one thread, one after another. A bit is written by reading
its byte first; the other bits keep the values that were read.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner.ports import AUTO, OUTPUT, PV
from autotuner_drivers.callables import Worker
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.options import Options, import_extra, refuse
from autotuner_drivers.remote import RemoteBackend
from autotuner_drivers.scaling import HIGHEST_FLOAT32, Modes, Scaling, read_scaling

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

T = TypeVar("T")
TYPES: Final = {
    "bool": "B",
    "byte": "B",
    "int": ">h",
    "word": ">H",
    "dint": ">i",
    "dword": ">I",
    "real": ">f",
    "lreal": ">d",
}
"""Codes of the module `struct` by S7 data type."""
FLOATS: Final = {"real": "float32", "lreal": "float64"}
AREAS: Final = {"db": "DB", "merker": "MK", "input": "PE", "output": "PA"}
"""Areas of the library by the names of the configuration."""
LONGEST_READ: Final = 200
"""Longest read, bytes: what the smallest PDU of a controller, 240 bytes, can carry."""
_MODES: Final = Modes(auto=(1,), manual=(0,))
_library_log = logging.getLogger("snap7")  # duplicates the errors of this driver
_library_log.addHandler(logging.NullHandler())
_library_log.propagate = False


@dataclass(frozen=True, slots=True)
class Variable:
    """One signal: area, number of the data block, byte, bit of a bool, data type and scaling."""

    name: str
    area: str
    db: int
    byte: int
    bit: int | None
    type: str
    scaling: Scaling

    @property
    def size(self) -> int:
        """Number of bytes."""
        return struct.calcsize(TYPES[self.type])

    @property
    def place(self) -> str:
        """Address of the variable, for messages."""
        area = f"DB{self.db}" if self.area == "db" else self.area
        return f"{area} byte {self.byte}" + ("" if self.bit is None else f" bit {self.bit}")

    def decode(self, data: bytes | bytearray) -> float:
        """Return the value of the variable's bytes; NaN for a real that is not a number."""
        raw: float = struct.unpack(TYPES[self.type], data)[0]
        value = self.scaling.value(raw if self.bit is None else int(raw) >> self.bit & 1)
        return value if math.isfinite(value) else math.nan

    def encode(self, value: float, held: bytes | bytearray) -> bytearray:
        """Return the bytes of a value; `held` is the present content, of which a bool changes one bit."""
        raw = self.scaling.raw(value)
        assert not isinstance(raw, str)  # noqa: S101 - narrows the type: checked when the table was read
        if self.bit is not None:
            if raw not in {0, 1}:
                raise self._refusal(value, "can only be 0 or 1")
            mask = 1 << self.bit
            return bytearray([held[0] | mask if raw else held[0] & ~mask])
        low, high = self.raw_limits
        raw = float(raw) if self.type in FLOATS else round(raw)
        if not low <= raw <= high:
            raise self._refusal(value, f"does not fit {self.type} at {self.place}")
        return bytearray(struct.pack(TYPES[self.type], raw))

    @property
    def raw_limits(self) -> tuple[float, float]:
        """Lowest and highest raw number."""
        if self.bit is not None:
            return 0, 1
        if self.type in FLOATS:
            return (-HIGHEST_FLOAT32, HIGHEST_FLOAT32) if self.type == "real" else (-math.inf, math.inf)
        bits = 8 * self.size
        return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if self.type in {"int", "dint"} else (0, 2**bits - 1)

    def _refusal(self, value: float, message: str) -> DeviceRefusedError:
        return DeviceRefusedError(message, field=self.name, value=value, remedy="Correct scale, type or the limits.")


def plan_reads(variables: Sequence[Variable]) -> list[list[Variable]]:
    """Group the variables by area or data block, so that one answer can hold each group."""
    groups: list[list[Variable]] = []
    for variable in sorted(variables, key=lambda v: (v.area, v.db, v.byte)):
        first = groups[-1][0] if groups else None
        joins = first is not None and (first.area, first.db) == (variable.area, variable.db)
        if first is not None and joins and variable.byte + variable.size - first.byte <= LONGEST_READ:
            groups[-1].append(variable)
        else:
            groups.append([variable])
    return groups


class S7Transport:
    """The variables of one loop.

    Parameters
    ----------
    host, port, rack, slot
        Address of the PLC.
    variables : dict
        Variables by signal.
    """

    def __init__(self, host: str, port: int, rack: int, slot: int, variables: dict[str, Variable]) -> None:
        self.label = f"{host}:{port} rack {rack} slot {slot}"
        self.readable = frozenset(variables)
        self.writable = frozenset(variables) - {PV}
        self._address, self._variables = (host, rack, slot, port), variables
        self._library = import_extra("s7", "snap7")
        self._errors = (import_extra("s7", "snap7.error").S7Error, RuntimeError)
        self._worker: Worker | None = None
        self._client: Any = None

    async def connect(self) -> None:
        """Connect in this connection's own thread."""
        self._worker = Worker(f"s7 {self.label}")
        client = self._client = self._library.client.Client()
        await self._call(client.connect, *self._address)

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the variables; neighbours share a request, and the last named is in the last request."""
        variables = [self._variables[name] for name in names]
        groups = sorted(plan_reads(variables), key=lambda group: variables[-1] in group)
        values: dict[str, float] = {}
        for group in groups:
            first, size = group[0], max(v.byte + v.size for v in group) - group[0].byte
            area = self._area(first)
            data = await self._call(self._client.read_area, area, first.db, first.byte, size)
            values |= {v.name: v.decode(data[v.byte - first.byte :][: v.size]) for v in group}
        return values

    async def write(self, name: str, value: float) -> None:
        """Write the variable; of a bool only its bit."""
        variable = self._variables[name]
        held = await self._bytes(variable) if variable.bit is not None else b""
        data = variable.encode(value, held)
        await self._call(self._client.write_area, self._area(variable), variable.db, variable.byte, data)

    async def disconnect(self, *, lost: bool) -> None:
        """Disconnect; a call that still blocks ends when its socket closes."""
        client, self._client = self._client, None
        worker, self._worker = self._worker, None
        if client is not None and worker is not None:
            ending = worker.submit(client.disconnect)
            worker.stop()
            if not lost:
                with contextlib.suppress(Exception):
                    await asyncio.wrap_future(ending)

    def error(self, error: Exception) -> DriverError | None:
        """Map an exception of the library to an error of the port: a refusal of the PLC, or a lost link."""
        if not isinstance(error, self._errors):
            return None
        if type(error).__name__ in {"S7ProtocolError", "S7AuthenticationError"}:
            return DeviceRefusedError(
                f"{self.label}: {error}",
                remedy="Check data block, byte and type, permit PUT/GET access, and do not optimise the data block.",
            )
        return LinkError(f"{self.label}: {error}", remedy=CHECK_LINE)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the range of the data type."""
        variable = self._variables[name]
        return variable.scaling.limits(*variable.raw_limits)

    def resolution(self, name: str, value: float) -> float:
        """Return the step of the data type."""
        variable = self._variables[name]
        return variable.scaling.resolution(FLOATS.get(variable.type, ""), value)

    async def _bytes(self, variable: Variable) -> bytearray:
        area = self._area(variable)
        return await self._call(self._client.read_area, area, variable.db, variable.byte, variable.size)

    async def _call(self, function: Callable[..., T], *arguments: object) -> T:
        assert self._worker is not None  # noqa: S101 - narrows the type: `connect` comes first
        return await asyncio.wrap_future(self._worker.submit(function, *arguments))

    def _area(self, variable: Variable) -> Any:
        return self._library.type.Area[AREAS[variable.area]]


def create(options: Mapping[str, object]) -> RemoteBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    host, port = table.text("host"), table.integer("port", 102, low=1, high=65535)
    rack, slot = table.integer("rack", 0, low=0, high=7), table.integer("slot", 1, low=0, high=31)
    timeout_s = table.number("timeout_s", 3.0, low=0.05, high=60.0, unit="s")
    entries = table.table("variables")
    variables = {name: _read_variable(name, entries.table(name)) for name in entries}
    for name in (PV, OUTPUT):
        if name not in variables:
            refuse(entries.key(name), None, "is missing", f'Add {name} = {{ db = 1, byte = 0, type = "real" }}.')
    table.done()
    return RemoteBackend(S7Transport(host, port, rack, slot, variables), timeout_s)


def _read_variable(name: str, options: Options) -> Variable:
    area = options.choice("area", tuple(AREAS), "db")
    bit = options.integer("bit", low=0, high=7) if "bit" in options else None
    kind = options.choice("type", tuple(TYPES), "real" if bit is None else "bool")
    if (bit is None) == (kind == "bool"):
        refuse(options.key("bit"), bit, f"does not fit the type {kind}", "Give `bit` for a bool, and for nothing else.")
    variable = Variable(
        name,
        area,
        options.integer("db", low=1, high=65535) if area == "db" else 0,
        options.integer("byte", low=0, high=65535),
        bit,
        kind,
        read_scaling(name, options, _MODES),
    )
    modes = variable.scaling.modes
    if name == AUTO and modes is not None and any(isinstance(raw, str) for raw in (*modes.auto, *modes.manual)):
        refuse(options.key("auto_value"), modes.auto, "must be numbers", "Write auto_value = 1.")
    options.done()
    return variable
