"""Driver `epics`: channels of EPICS input/output controllers by Channel Access (extra `epics`, package caproto).

Options (table ``[loops.NAME.device]``), with their defaults::

    host = "192.168.1.30"            # required: the IOC, a gateway, or with `search` a broadcast address
    port = 5064
    search = true                    # find the server of each channel by UDP at host:port; false: connect to
                                     # host:port by TCP at once, where UDP does not pass
    timeout_s = 3.0                  # longest wait for a connection, and for an answer

    [loops.NAME.device.channels]     # pv and output are required
    pv = { name = "LAB:TEMP", max_age_s = 5.0 }
    output = { name = "LAB:HEATER", read_name = "LAB:HEATER:RBV" }
    set_point = { name = "LAB:TEMP:SP", scale = 0.1 }
    auto = { name = "LAB:MODE", auto_value = "Auto", manual_value = "Manual" }

`scale`, `offset` as in all drivers. The values of `auto` are numbers, or the state strings of an enumerated record. In
a list, all values are recognised and the first is written. Writes wait until the record has been processed (put
callback). A value of alarm severity INVALID is NaN, and so is one whose timestamp has not changed for `max_age_s`.
Minor and major alarms are measurements. The control limits of a record are the limits of its signal: beyond them an
IOC clips silently.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner.ports import OUTPUT, PV
from autotuner_drivers.epics.circuit import Circuit, search
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.options import Options, import_extra, refuse
from autotuner_drivers.remote import RemoteBackend
from autotuner_drivers.scaling import Modes, Raw, Scaling, read_scaling

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

STRING, ENUM = 0, 3
"""Native data types of the protocol; the others are numbers."""
KINDS: Final = {2: "float32", 6: "float64"}
INTEGERS: Final = {1: (-(2**15), 2**15 - 1), 3: (0, 2**16 - 1), 4: (0, 2**8 - 1), 5: (-(2**31), 2**31 - 1)}
"""Lowest and highest value by native data type: short, enumerated, char, long."""
WITH_TIME, WITH_CONTROL = 14, 28
"""Added to a native data type: the value with its alarm and time, or with its limits and units."""
SEARCH_SHARE: Final = 0.6
"""Share of the time limit of a connection in which the servers are searched."""
INVALID: Final = 3
"""Alarm severity of a value that must not be used."""
DEFAULT_PORT: Final = 5064
"""Port of Channel Access servers (EPICS_CA_SERVER_PORT)."""
_MODES: Final = Modes(auto=(1,), manual=(0,))
_log = logging.getLogger("autotuner.drivers.epics")
_library_log = logging.getLogger("caproto")  # duplicates the errors of this driver
_library_log.addHandler(logging.NullHandler())
_library_log.propagate = False


@dataclass(frozen=True, slots=True)
class Channel:
    """One signal: the names of the channels that are written and read, scaling, and the oldest timestamp, s."""

    name: str
    write: str
    read: str
    scaling: Scaling
    max_age_s: float


@dataclass(frozen=True, slots=True)
class Place:
    """A channel on its circuit, with the limits and state strings of its record."""

    circuit: Circuit
    channel: Any
    low: float = -math.inf
    high: float = math.inf
    labels: tuple[str, ...] = ()

    @property
    def type(self) -> int:
        """Native data type."""
        return int(self.channel.native_data_type)


class EpicsTransport:
    """The channels of one loop.

    Parameters
    ----------
    address : tuple of str and int
        Where channels are searched, or found.
    searches : bool
        Whether the server of each channel is searched by UDP.
    channels : dict
        Channels by signal.
    timeout_s : float
        Longest time of connecting, s.
    """

    def __init__(
        self, address: tuple[str, int], *, searches: bool, channels: dict[str, Channel], timeout_s: float
    ) -> None:
        self.label = f"{address[0]}:{address[1]}"
        self.readable = frozenset(channels)
        self.writable = frozenset(channels) - {PV}
        self.gone: Callable[[str], None] | None = None
        self._address, self._searches = address, searches
        self._channels, self._timeout_s = channels, timeout_s
        self._library = import_extra("epics", "caproto")
        self._circuits: dict[tuple[str, int], Circuit] = {}
        self._places: dict[str, Place] = {}
        self._stamps: dict[str, tuple[float, float]] = {}
        self._reasons: dict[str, str] = {}

    async def connect(self) -> None:
        """Find the servers of the channels, connect to them, and read the metadata of the records."""
        names = sorted({name for channel in self._channels.values() for name in (channel.read, channel.write)})
        self._stamps = {}
        servers = await self._servers(names)
        for server in dict.fromkeys(servers.values()):
            self._circuits[server] = Circuit(server, self._lost)
            await self._circuits[server].open()
        places = await asyncio.gather(*(self._place(name, self._circuits[servers[name]]) for name in names))
        self._places = dict(zip(names, places, strict=True))

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the channels, which are read at the same time."""
        values = await asyncio.gather(*(self._value(self._channels[name]) for name in names))
        return dict(zip(names, values, strict=True))

    async def write(self, name: str, value: float) -> None:
        """Write the channel in its own data type, and wait until its record has been processed."""
        channel = self._channels[name]
        place = self._places[channel.write]
        await place.circuit.write(place.channel, self._raw(channel, place, value))

    async def disconnect(self, *, lost: bool) -> None:  # noqa: ARG002 - a circuit is closed in the same way
        """Close the circuits."""
        circuits, self._circuits, self._places = self._circuits, {}, {}
        for circuit in circuits.values():
            await circuit.close()

    def error(self, error: Exception) -> DriverError | None:
        """Map an exception of the library, a violation of the protocol, to an error of the port."""
        if isinstance(error, self._library.CaprotoError):
            return LinkError(f"{self.label} cannot be used: {error}", remedy=CHECK_LINE)
        return None

    def limits(self, name: str) -> tuple[float, float]:
        """Return the control limits of the record, or the range of its data type, once connected."""
        channel = self._channels[name]
        place = self._places.get(channel.write)
        return channel.scaling.limits(place.low, place.high) if place else (-math.inf, math.inf)

    def resolution(self, name: str, value: float) -> float:
        """Return the step of the data type, once it is known."""
        channel = self._channels[name]
        place = self._places.get(channel.write)
        return channel.scaling.resolution(KINDS.get(place.type, ""), value) if place else 0.0

    async def _servers(self, names: Sequence[str]) -> dict[str, tuple[str, int]]:
        if not self._searches:
            return dict.fromkeys(names, self._address)
        found = await search(names, self._address, SEARCH_SHARE * self._timeout_s)
        if missing := [name for name in names if name not in found]:
            raise LinkError(
                f"no server at {self.label} has {', '.join(missing)}",
                remedy="Check the names with `caget`, the address, and that UDP passes; else set search = false.",
            )
        return found

    async def _place(self, name: str, circuit: Circuit) -> Place:
        """Return a channel with the limits or the state strings of its record."""
        channel = await circuit.create(name)
        kind = int(channel.native_data_type)
        if kind == STRING:
            return Place(circuit, channel)
        metadata = (await circuit.read(channel, kind + WITH_CONTROL)).metadata
        if kind == ENUM:
            return Place(circuit, channel, *INTEGERS[kind], tuple(text.decode() for text in metadata.enum_strings))
        low, high = float(metadata.lower_ctrl_limit), float(metadata.upper_ctrl_limit)
        if low < high:
            return Place(circuit, channel, low, high)
        return Place(circuit, channel, *INTEGERS.get(kind, (-math.inf, math.inf)))

    async def _value(self, channel: Channel) -> float:
        """Return a value; the reason of one that is NaN goes to the log once."""
        place = self._places[channel.read]
        answer = await place.circuit.read(place.channel, place.type + WITH_TIME)
        reason = self._reason(channel, answer.metadata)
        if reason != self._reasons.get(channel.name, ""):
            self._reasons[channel.name] = reason
            _log.warning("%s: %s of %s", channel.name, reason or "valid again", self.label)
        return math.nan if reason else channel.scaling.value(_configured_raw(channel, place, answer.data[0]))

    def _reason(self, channel: Channel, metadata: Any) -> str:
        """Return why the record reports its value as unusable; empty for a valid value."""
        now_s = asyncio.get_running_loop().time()
        if self._stamps.get(channel.name, (math.nan, 0.0))[0] != metadata.timestamp:
            self._stamps[channel.name] = (metadata.timestamp, now_s)
        unchanged_s = now_s - self._stamps[channel.name][1]
        if int(metadata.severity) >= INVALID:
            return f"the record reports severity INVALID, status {self._library.AlarmStatus(int(metadata.status)).name}"
        return f"its timestamp is {unchanged_s:.1f} s old" if unchanged_s > channel.max_age_s else ""

    def _raw(self, channel: Channel, place: Place, value: float) -> float | bytes:
        """Return what is written into a record; a value that does not fit is refused, never wrapped or clipped."""
        if not self._library.AccessRights.WRITE & place.channel.access_rights:
            raise _refused(channel, value, "is read-only at the IOC")
        raw = channel.scaling.raw(value)
        if isinstance(raw, str) and place.type == ENUM and raw in place.labels:
            return place.labels.index(raw)
        if place.type == STRING:
            return str(raw).encode()
        if isinstance(raw, str):
            raise _refused(channel, value, f"is the text {raw!r}, not one of {', '.join(place.labels) or 'none'}")
        if not place.low <= raw <= place.high:
            raise _refused(channel, value, f"is beyond the limits of the record, {place.low:g} to {place.high:g}")
        return float(raw) if place.type in KINDS else round(raw)

    def _lost(self, reason: str) -> None:
        if self.gone is not None:
            self.gone(f"{self.label}: {reason}")


def _configured_raw(channel: Channel, place: Place, raw: Any) -> Raw:
    """Return a raw value as the configuration writes it: a state string where the modes are texts."""
    modes = channel.scaling.modes
    if place.type == ENUM and modes is not None and any(isinstance(mode, str) for mode in (*modes.auto, *modes.manual)):
        return place.labels[int(raw)] if int(raw) < len(place.labels) else int(raw)
    if place.type != STRING:
        return float(raw)
    text: str = raw.decode(errors="replace")
    if modes is None:
        raise _refused(channel, text, "holds a text, not a number")
    return text


def _refused(channel: Channel, value: object, message: str) -> DeviceRefusedError:
    return DeviceRefusedError(
        message, field=f"channels.{channel.name}", value=value, remedy=f"Check the record {channel.write}."
    )


def create(options: Mapping[str, object]) -> RemoteBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    address = table.text("host"), table.integer("port", DEFAULT_PORT, low=1, high=65535)
    searches = table.flag("search", default=True)
    timeout_s = table.number("timeout_s", 3.0, low=0.05, high=60.0, unit="s")
    entries = table.table("channels")
    channels = {name: _read_channel(name, entries.table(name)) for name in entries}
    for name in (PV, OUTPUT):
        if name not in channels:
            refuse(entries.key(name), None, "is missing", f'Add {name} = {{ name = "LAB:{name.upper()}" }}.')
    table.done()
    return RemoteBackend(EpicsTransport(address, searches=searches, channels=channels, timeout_s=timeout_s), timeout_s)


def _read_channel(name: str, options: Options) -> Channel:
    record = options.text("name")
    channel = Channel(
        name,
        record,
        options.text("read_name", record),
        read_scaling(name, options, _MODES),
        options.number("max_age_s", low=0.001, high=1e6, unit="s") if "max_age_s" in options else math.inf,
    )
    options.done()
    return channel
