"""Driver `ethernetip`: tags of a Logix controller by EtherNet/IP (extra `ethernetip`, package pylogix).

Options (table ``[loops.NAME.device]``), with their defaults::

    host = "192.168.1.40"            # required
    port = 44818
    slot = 0                         # slot of the processor in the chassis
    micro800 = false                 # true: a Micro800, which has no backplane
    timeout_s = 3.0                  # longest wait for a connection, and for an answer

    [loops.NAME.device.tags]         # pv and output are required
    pv = { tag = "TIC101.PV" }
    output = { tag = "TIC101.CVOper", read_tag = "TIC101.CV" }
    set_point = { tag = "Program:Main.SP", scale = 0.1 }
    auto = { tag = "TIC101_Mode", auto_value = [1, 2], manual_value = 0 }

`scale`, `offset` as in all drivers; data types are those of the controller. All tags of a reading share one
request. A bit of an integer is named as in the controller, `Word.3`.

Invariants: the library blocks, so its calls run in one thread, one after another. A connection is made in `connect`
only, never within another call, so a write is never sent after its time limit.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
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
BOOL: Final = 0xC1
"""CIP data type of a bit."""
FLOATS: Final = {0xCA: "float32", 0xCB: "float64"}
INTEGERS: Final = {
    BOOL: (0, 1),
    0xC2: (-(2**7), 2**7 - 1),
    0xC3: (-(2**15), 2**15 - 1),
    0xC4: (-(2**31), 2**31 - 1),
    0xC5: (-(2**63), 2**63 - 1),
    0xC6: (0, 2**8 - 1),
    0xC7: (0, 2**16 - 1),
    0xC8: (0, 2**32 - 1),
}
"""Lowest and highest value by CIP data type: BOOL, SINT, INT, DINT, LINT, USINT, UINT, UDINT (CIP volume 1, C-6)."""
SUCCESS: Final = "Success"
REFUSALS: Final = {
    "Path segment error": "Check the name of the tag.",
    "Path destination unknown": "Check the name of the tag; one of a program is named Program:NAME.TAG.",
    "Privilege violation": "Set External Access of the tag to Read/Write.",
    "Attribute not settable": "Set External Access of the tag to Read/Write.",
    "Invalid parameter value": "Check the value against the data type of the tag.",
    "Not enough data": "Check that the tag is a number, not a structure or an array.",
    "Vendor specific": "Check that the tag is a number, not a structure or an array.",
    "Object state conflict": "Check the mode of the controller.",
    "Device state conflict": "Check the mode of the controller.",
}
"""Status texts of a refused request, with the remedy; any other status is a lost link."""
_MODES: Final = Modes(auto=(1,), manual=(0,))
_library_log = logging.getLogger("pylogix")  # duplicates the errors of this driver
_library_log.addHandler(logging.NullHandler())
_library_log.propagate = False


@dataclass(frozen=True, slots=True)
class Tag:
    """One signal: the tags that are written and read, and the scaling."""

    name: str
    write: str
    read: str
    scaling: Scaling


class EthernetIpTransport:
    """The tags of one loop.

    Parameters
    ----------
    settings : mapping
        Arguments of the library's connection: address, slot, kind of controller, time limit.
    tags : dict
        Tags by signal.
    """

    def __init__(self, settings: Mapping[str, object], tags: dict[str, Tag]) -> None:
        self.label = f"{settings['ip_address']}:{settings['port']} slot {settings['slot']}"
        self.readable = frozenset(tags)
        self.writable = frozenset(tags) - {PV}
        self._settings, self._tags = settings, tags
        self._library = import_extra("ethernetip", "pylogix")
        self._names = import_extra("ethernetip", "pylogix.utils")
        self._types: dict[str, int] = {}
        self._worker: Worker | None = None
        self._plc: Any = None

    async def connect(self) -> None:
        """Connect in this connection's own thread, and read the data types of the tags."""
        self._worker = Worker(f"ethernetip {self.label}")
        plc = self._plc = self._library.PLC(**self._settings)
        plc.conn.msg_socket.close()  # for incoming messages, unused; the library leaves it open
        connected, reason = await self._call(plc.conn.connect)
        if not connected:
            cause = reason if isinstance(reason, OSError) else None
            raise LinkError(f"{self.label} cannot be reached: {reason}", remedy=CHECK_LINE) from cause
        for tag in self._tags.values():
            await self._read([tag], [tag.write])
            self._types[tag.name] = self._type(tag.write)

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the values of the tags, in one request where the controller accepts it."""
        tags = [self._tags[name] for name in names]
        answers = await self._read(tags, [tag.read for tag in tags])
        return {tag.name: _finite(tag.scaling.value(answer)) for tag, answer in zip(tags, answers, strict=True)}

    async def write(self, name: str, value: float) -> None:
        """Write the tag in its own data type."""
        tag = self._tags[name]
        raw = self._raw(tag, value)
        self._check(tag, tag.write, await self._call(self._connected, lambda plc: plc.Write(tag.write, raw)))

    async def disconnect(self, *, lost: bool) -> None:
        """Disconnect; a call that still blocks ends at its time limit."""
        plc, self._plc = self._plc, None
        worker, self._worker = self._worker, None
        if plc is None or worker is None:
            return
        if lost:
            plc.conn.SocketConnected = False
        ending = worker.submit(plc.conn.Socket.close if lost else plc.conn.close)
        worker.stop()
        if not lost:
            with contextlib.suppress(Exception):
                await asyncio.wrap_future(ending)

    def error(self, error: Exception) -> DriverError | None:  # noqa: ARG002 - the library has no exceptions of its own
        """Return None: the library reports by status."""
        return None

    def limits(self, name: str) -> tuple[float, float]:
        """Return the range of the data type, once connected."""
        return self._tags[name].scaling.limits(*_raw_limits(self._types.get(name)))

    def resolution(self, name: str, value: float) -> float:
        """Return the step of the data type, once connected."""
        kind = self._types.get(name)
        return self._tags[name].scaling.resolution(FLOATS.get(kind, ""), value) if kind else 0.0

    async def _read(self, tags: Sequence[Tag], places: list[str]) -> list[float]:
        answers = await self._call(self._connected, lambda plc: plc.Read(places))
        for tag, place, answer in zip(tags, places, answers, strict=True):
            self._check(tag, place, answer)
        return [answer.Value for answer in answers]

    def _connected(self, call: Callable[[Any], T]) -> T:
        """Call the library; raise `LinkError` where the library would reconnect on its own."""
        plc = self._plc
        if plc is None or not plc.conn.SocketConnected:
            raise LinkError(f"{self.label} has closed the connection", remedy=CHECK_LINE)
        return call(plc)

    def _check(self, tag: Tag, place: str, answer: Any) -> None:
        if answer.Status in REFUSALS:
            raise DeviceRefusedError(
                f"was refused by {self.label}: {answer.Status}",
                field=f"tags.{tag.name}",
                value=place,
                remedy=REFUSALS[answer.Status],
            )
        if answer.Status != SUCCESS:
            raise LinkError(f"{self.label}: {answer.Status}", remedy=CHECK_LINE)
        if answer.Value is not None and not isinstance(answer.Value, int | float):
            raise DeviceRefusedError(
                f"holds a {type(answer.Value).__name__}, not a number",
                field=f"tags.{tag.name}",
                value=place,
                remedy="Name a tag, or a member of a structure, that is a number.",
            )

    def _type(self, place: str) -> int:
        """Return the data type of a tag that has been read; BOOL for a bit of an integer."""
        if self._names.bit_of_word(place):
            return BOOL
        return int(self._plc.KnownTags[self._names.parse_tag_name(place)[1]][0])

    def _raw(self, tag: Tag, value: float) -> float | bool:
        """Return the raw value of a write; refuse a value that does not fit, never wrap or clip it."""
        raw, kind = tag.scaling.raw(value), self._types[tag.name]
        assert not isinstance(raw, str)  # noqa: S101 - narrows the type: checked when the table was read
        low, high = _raw_limits(kind)
        held = float(raw) if kind in FLOATS else round(raw)
        if not low <= held <= high or (kind == BOOL and raw not in {0, 1}):
            raise DeviceRefusedError(
                f"does not fit the data type of {tag.write}, {low:g} to {high:g}",
                field=f"tags.{tag.name}",
                value=value,
                remedy="Correct scale, offset and the loop's limits.",
            )
        return held

    async def _call(self, function: Callable[..., T], *arguments: object) -> T:
        assert self._worker is not None  # noqa: S101 - narrows the type: `connect` comes first
        return await asyncio.wrap_future(self._worker.submit(function, *arguments))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def _raw_limits(kind: int | None) -> tuple[float, float]:
    if kind in FLOATS:
        return (-HIGHEST_FLOAT32, HIGHEST_FLOAT32) if FLOATS[kind] == "float32" else (-math.inf, math.inf)
    return INTEGERS.get(kind or 0, (-math.inf, math.inf))


def create(options: Mapping[str, object]) -> RemoteBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    timeout_s = table.number("timeout_s", 3.0, low=0.05, high=60.0, unit="s")
    settings = {
        "ip_address": table.text("host"),
        "port": table.integer("port", 44818, low=1, high=65535),
        "slot": table.integer("slot", 0, low=0, high=17),
        "Micro800": table.flag("micro800", default=False),
        "timeout": timeout_s,
    }
    entries = table.table("tags")
    tags = {name: _read_tag(name, entries.table(name)) for name in entries}
    for name in (PV, OUTPUT):
        if name not in tags:
            refuse(entries.key(name), None, "is missing", f'Add {name} = {{ tag = "TIC101.{name.upper()}" }}.')
    table.done()
    return RemoteBackend(EthernetIpTransport(settings, tags), timeout_s)


def _read_tag(name: str, options: Options) -> Tag:
    place = options.text("tag")
    tag = Tag(name, place, options.text("read_tag", place), read_scaling(name, options, _MODES))
    modes = tag.scaling.modes
    if name == AUTO and modes is not None and any(isinstance(raw, str) for raw in (*modes.auto, *modes.manual)):
        refuse(options.key("auto_value"), modes.auto, "must be numbers", "Write auto_value = 1.")
    options.done()
    return tag
