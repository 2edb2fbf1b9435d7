"""Search of each protocol for readable addresses. Only reads are sent."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import struct
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from autotuner.errors import AutotunerError, InputError, LinkError
from autotuner.ports import OUTPUT, PV
from autotuner_drivers import ethernetip, s7, serial
from autotuner_drivers.epics.backend import DEFAULT_PORT as EPICS_PORT
from autotuner_drivers.epics.backend import create as create_epics
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.options import import_extra
from autotuner_drivers.testing.discovery import Place

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from urllib.parse import SplitResult

    from autotuner.ports import Backend
    from autotuner_drivers.testing.discovery import Search

TIMEOUT_S: Final = 2.0
"""Longest wait for an answer during a search, s."""


class ModbusSearch:
    """Units, and registers 0 to 99 of each table of the first unit that answers."""

    driver, table = "modbus", "registers"
    units = (1, 255, 0, 2, 3)
    tables = ("input", "holding", "coil", "discrete")
    bits = frozenset({"coil", "discrete"})
    block, last = 10, 100
    """Registers in one request, which are read one by one where the device refuses, and the end of the range."""

    def __init__(self, parts: SplitResult) -> None:
        host, port = parts.hostname or "", parts.port or 502
        self.label = f"{host}:{port}"
        self.device: dict[str, object] = {"host": host, "port": port}
        self.notes: list[str] = []
        self._client = AsyncModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0, reconnect_delay=0)
        self._unit = 0
        self._blocks: list[tuple[str, int, int]] = []

    async def start(self) -> list[Place]:
        """Find the units that answer, and the readable blocks of the first one."""
        if not await self._client.connect():
            raise LinkError(f"nothing answers at {self.label}", remedy=CHECK_LINE)
        units = [unit for unit in self.units if await self._answers(unit)]
        if not units:
            raise LinkError(f"{self.label} answers no read of its first registers", remedy="Check the unit identifier.")
        self._unit = units[0]
        self.device["unit"] = units[0]
        self.notes.append(f"units that answer: {', '.join(map(str, units))}; listed is {units[0]}")
        for table in self.tables:
            for first in range(0, self.last, self.block):
                await self._try(table, first)
        self.notes += [f"readable: {table} {span}" for table in self.tables for span in self._spans(table)]
        return [self._place(table, first + k) for table, first, count in self._blocks for k in range(count)]

    async def look(self) -> list[float]:
        """Return the words of all blocks."""
        values: list[float] = []
        for table, first, count in self._blocks:
            words = await self._read(self._unit, table, first, count)
            values += words or [math.nan] * count
        return values

    async def close(self) -> None:
        """Disconnect."""
        self._client.close()

    async def _answers(self, unit: int) -> bool:
        for table in self.tables:
            if await self._read(unit, table, 0, 1) is not None:
                return True
        return False

    async def _try(self, table: str, first: int) -> None:
        if await self._read(self._unit, table, first, self.block) is not None:
            self._blocks.append((table, first, self.block))
            return
        for address in range(first, first + self.block):
            if await self._read(self._unit, table, address, 1) is not None:
                self._blocks.append((table, address, 1))

    def _spans(self, table: str) -> list[str]:
        """Return the addresses that can be read as spans."""
        held = sorted(first + k for name, first, count in self._blocks if name == table for k in range(count))
        first = [a for a in held if a - 1 not in held]
        last = [a for a in held if a + 1 not in held]
        return [f"{a} to {b}" for a, b in zip(first, last, strict=True)]

    def _place(self, table: str, address: int) -> Place:
        return Place(f"{table} {address}", {"table": table, "address": address}, table in {"holding", "coil"})

    async def _read(self, unit: int, table: str, address: int, count: int) -> list[float] | None:
        """Return signed words or bits; None where the device refuses or does not answer."""
        call: Any = {
            "input": self._client.read_input_registers,
            "holding": self._client.read_holding_registers,
            "coil": self._client.read_coils,
            "discrete": self._client.read_discrete_inputs,
        }[table]
        try:
            answer = await call(address, count=count, device_id=unit)
        except (ModbusException, OSError):
            await self._client.connect()
            return None
        if answer.isError():
            return None
        if table in self.bits:
            return [float(bit) for bit in answer.bits[:count]]
        return [float((word ^ 0x8000) - 0x8000) for word in answer.registers]


class OpcUaSearch:
    """The variables below Objects that hold a number."""

    driver, table = "opcua", "nodes"
    most = 500
    server_object = 2253

    def __init__(self, parts: SplitResult) -> None:
        self._library = import_extra("opcua", "asyncua")
        self._client = self._library.Client(parts.geturl(), TIMEOUT_S)
        self.device: dict[str, object] = {"endpoint": parts.geturl()}
        self.notes: list[str] = []
        self._nodes: list[Any] = []
        self._connected = False

    async def start(self) -> list[Place]:
        """Browse the tree."""
        try:
            async with asyncio.timeout(5.0 * TIMEOUT_S):
                await self._client.connect()
        except Exception as error:
            raise LinkError(f"nothing answers at {self.device['endpoint']}: {error}", remedy=CHECK_LINE) from error
        self._connected = True
        places = []
        async for node, path in self._variables():
            if not math.isnan(await _number_of(node)):
                self._nodes.append(node)
                places.append(await self._place(node, path))
        return places

    async def look(self) -> list[float]:
        """Return the values."""
        return [await _number_of(node) for node in self._nodes]

    async def close(self) -> None:
        """Disconnect."""
        if self._connected:
            await self._client.disconnect()

    async def _place(self, node: Any, path: str) -> Place:
        writable = self._library.ua.AccessLevel.CurrentWrite in await node.get_user_access_level()
        unit, span = "", None
        for child in await node.get_children():
            name = (await child.read_browse_name()).Name
            with contextlib.suppress(Exception):  # a property without a value is skipped
                if name == "EngineeringUnits":
                    unit = (await child.read_value()).DisplayName.Text or ""
                elif name == "EURange":
                    limits = await child.read_value()
                    span = (float(limits.Low), float(limits.High))
        identifier = node.nodeid.to_string()
        return Place(f"{path}  {identifier}", {"node": identifier}, writable, unit, span)

    async def _variables(self) -> Any:
        """Yield the variables below Objects and their paths, breadth first, without the server's own object."""
        ua, visited, count = self._library.ua, set(), 0
        waiting = [(self._client.nodes.objects, "")]
        while waiting and count < self.most:
            parent, path = waiting.pop(0)
            for child in await parent.get_children():
                own = child.nodeid.NamespaceIndex == 0 and child.nodeid.Identifier == self.server_object
                if child.nodeid in visited or own:
                    continue
                visited.add(child.nodeid)
                name = f"{path}/{(await child.read_browse_name()).Name}".lstrip("/")
                if await child.read_node_class() == ua.NodeClass.Variable:
                    count += 1
                    yield child, name
                else:
                    waiting.append((child, name))


async def _number_of(node: Any) -> float:
    try:
        value = await node.read_value()
    except Exception:  # noqa: BLE001 - a bad status, or a type that cannot be decoded: not a signal of a loop
        return math.nan
    return float(value) if isinstance(value, int | float) else math.nan


class MqttSearch:
    """Topics whose payload is a number, or JSON with numbers in it."""

    driver, table = "mqtt", "topics"
    listen_s = 3.0
    """Duration for which topics are collected before the first reading, s."""

    def __init__(self, parts: SplitResult) -> None:
        self._library = import_extra("mqtt", "aiomqtt")
        self._address = parts.hostname or "", parts.port or 1883
        prefix = parts.path.strip("/")
        self._filter = f"{prefix}/#" if prefix else "#"
        self.device: dict[str, object] = {"host": self._address[0], "port": self._address[1], "interval_s": 10.0}
        self.notes = ["topics that set a signal cannot be seen: `command` is a guess"]
        self._client: Any = None
        self._latest: dict[tuple[str, str], float] = {}
        self._places: list[tuple[str, str]] = []
        self._listening: asyncio.Task[None] | None = None

    async def start(self) -> list[Place]:
        """Subscribe, and collect."""
        client = self._library.Client(*self._address, timeout=TIMEOUT_S)
        try:
            await client.__aenter__()
        except self._library.MqttError as error:
            raise LinkError(
                f"no broker answers at {':'.join(map(str, self._address))}: {error}", remedy=CHECK_LINE
            ) from error
        self._client = client
        await client.subscribe(self._filter)
        self._listening = asyncio.ensure_future(self._listen())
        await asyncio.sleep(self.listen_s)
        self._places = sorted(self._latest)
        return [self._place(topic, path) for topic, path in self._places]

    async def look(self) -> list[float]:
        """Return the last value of each topic."""
        return [self._latest[place] for place in self._places]

    async def close(self) -> None:
        """Disconnect."""
        if self._listening is not None:
            self._listening.cancel()
            await asyncio.gather(self._listening, return_exceptions=True)
        if self._client is not None:
            await self._client.__aexit__(None, None, None)

    def _place(self, topic: str, path: str) -> Place:
        entry = {"topic": topic} | ({"json": path} if path else {}) | {"command": f"{topic}/set"}
        return Place(f"{topic} {path}".rstrip(), entry, writable=True)

    async def _listen(self) -> None:
        async for message in self._client.messages:
            for path, value in numbers_in(bytes(message.payload or b"")):
                self._latest[str(message.topic), path] = value


def numbers_in(payload: bytes) -> list[tuple[str, float]]:
    """Return the numbers of a payload with their paths; the path of a payload that is a number is empty."""
    try:
        return list(_leaves("", json.loads(payload)))
    except ValueError:
        return []


def _leaves(path: str, value: object) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from _leaves(f"{path}.{key}".lstrip("."), item)
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)


class BackendSearch:
    """Addresses that the driver itself reads: each is a signal of a backend that the search creates."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._backend: Backend | None = None
        self._names: list[str] = []

    async def opened(self, backend: Backend, names: Sequence[str]) -> None:
        """Open the backend whose signals are read from then on."""
        self._backend, self._names = backend, list(names)
        await backend.open()

    async def look(self) -> list[float]:
        """Return the values."""
        assert self._backend is not None  # noqa: S101 - narrows the type: `opened` comes first
        values = await self._backend.read(self._names)
        return [values[name] for name in self._names]

    async def close(self) -> None:
        """Disconnect."""
        if self._backend is not None:
            await self._backend.close()


def _signals(entries: Sequence[dict[str, object]]) -> dict[str, dict[str, object]]:
    """Return a table of signals with these entries; the first is PV and output too, which a driver requires."""
    return {PV: entries[0], OUTPUT: entries[0]} | {f"place{k}": entry for k, entry in enumerate(entries)}


class NamedSearch(BackendSearch):
    """Addresses that the user names, because the protocol has no list of them."""

    def __init__(self, names: str, key: str, create: Callable[[dict[str, object]], Any], like: str) -> None:
        super().__init__()
        self.device: dict[str, object] = {}
        self.table = ""
        self._places = [name for name in names.split(",") if name]
        self._key, self._create, self._like = key, create, like

    async def start(self) -> list[Place]:
        """Open the named addresses and read their ranges."""
        if not self._places:
            raise InputError("names nothing to read", field="address", remedy=f"Write {self._like}.")
        entries: list[dict[str, object]] = [{self._key: name} for name in self._places]
        backend = self._create(self.device | {self.table: _signals(entries)})
        await self.opened(backend, [f"place{k}" for k in range(len(entries))])
        ranges = [backend.limits(name) for name in self._names]
        return [
            Place(name, entry, writable=True, range=ends if all(map(_usual, ends)) else None)
            for name, entry, ends in zip(self._places, entries, ranges, strict=True)
        ]


def _usual(end: float) -> bool:
    """Return whether a range limit is informative and not that of the data type."""
    return abs(end) < 2.0**15 - 1.0


class EpicsSearch(NamedSearch):
    """Channels that the user names."""

    driver = "epics"

    def __init__(self, parts: SplitResult) -> None:
        super().__init__(parts.path.strip("/"), "name", create_epics, "epics://HOST/LAB:TEMP,LAB:HEATER")
        self.table = "channels"
        self.device = {"host": parts.hostname or "", "port": parts.port or EPICS_PORT}


class EtherNetIpSearch(NamedSearch):
    """Tags of a Logix controller: all tags, or those that the user names."""

    driver = "ethernetip"

    def __init__(self, parts: SplitResult) -> None:
        slot, _, names = parts.path.strip("/").partition("/")
        super().__init__(names, "tag", ethernetip.create, "ethernetip://HOST/SLOT/TAG,TAG")
        self.table = "tags"
        self.device = {"host": parts.hostname or "", "port": parts.port or 44818, "slot": int(slot or 0)}

    async def start(self) -> list[Place]:
        """List the tags unless the user names them."""
        if not self._places:
            self._places = await asyncio.to_thread(self._listed)
            self.notes.append(f"the controller lists {len(self._places)} tags that are numbers")
        return await super().start()

    def _listed(self) -> list[str]:
        library = import_extra("ethernetip", "pylogix")
        with library.PLC(self.device["host"], self.device["slot"], TIMEOUT_S, port=self.device["port"]) as plc:
            plc.conn.msg_socket.close()
            tags = plc.GetTagList().Value or []
            kinds = {
                name for _, name, _ in plc.CIPTypes.values() if name in {"REAL", "LREAL", "SINT", "INT", "DINT", "BOOL"}
            }
        return [tag.TagName for tag in tags if tag.DataType in kinds and not tag.Array]


class S7Search(BackendSearch):
    """Reals of the data blocks 1 to 99, at every fourth byte."""

    driver, table = "s7", "variables"
    last_block, longest = 99, 256

    def __init__(self, parts: SplitResult) -> None:
        super().__init__()
        rack, _, slot = parts.path.strip("/").partition("/")
        self.device: dict[str, object] = {
            "host": parts.hostname or "", "port": parts.port or 102, "rack": int(rack or 0), "slot": int(slot or 1),
        }  # fmt: skip

    async def start(self) -> list[Place]:
        """Find the data blocks and their lengths."""
        blocks = await asyncio.to_thread(self._blocks)
        entries: list[dict[str, object]] = [
            {"db": db, "byte": byte}
            for db, data in blocks.items()
            for byte in range(0, len(data), 4)
            if _is_real(data[byte:])
        ]
        self.notes.append(
            f"data blocks: {', '.join(f'DB{db} ({len(data)} bytes and more)' for db, data in blocks.items())}"
        )
        if not entries:
            raise LinkError(f"no data block of {self.device['host']} holds a real", remedy="Permit PUT/GET access.")
        names = [f"place{k}" for k in range(len(entries))]
        await self.opened(s7.create(self.device | {self.table: _signals(entries)}), names)
        return [Place(f"DB{entry['db']} byte {entry['byte']}", entry, writable=True) for entry in entries]

    def _blocks(self) -> dict[int, bytes]:
        client = import_extra("s7", "snap7").client.Client()
        held: dict[int, bytes] = {}
        try:
            client.connect(*(self.device[key] for key in ("host", "rack", "slot", "port")))
            for db in range(1, self.last_block + 1):
                for size in (4, 16, 64, self.longest):
                    try:
                        held[db] = bytes(client.db_read(db, 0, size))
                    except Exception:  # noqa: BLE001 - no such block, or no longer
                        break
        except Exception as error:
            raise LinkError(f"nothing answers at {self.device['host']}: {error}", remedy=CHECK_LINE) from error
        finally:
            client.disconnect()
        return held


def _is_real(data: bytes) -> bool:
    """Return whether four bytes are a plausible real: 0, or a magnitude that occurs in a plant."""
    value = abs(struct.unpack(">f", data[:4])[0]) if len(data) >= 4 else math.nan
    return value == 0.0 or 1e-4 < value < 1e6


class SerialSearch(BackendSearch):
    """The protocol that answers at a serial port; opening the port resets many boards."""

    driver, table = "serial", ""
    protocols = ("tclab", "lakeshore", "eurotherm")

    def __init__(self, parts: SplitResult) -> None:
        super().__init__()
        self.device: dict[str, object] = {"serial_port": parts.path}

    async def start(self) -> list[Place]:
        """Read PV and output with one protocol after another."""
        tried = []
        for protocol in self.protocols:
            device = self.device | {"protocol": protocol, "timeout_s": 0.5, "retries": 1}
            try:
                await self.opened(serial.create(device), [PV, OUTPUT])
                await self.look()
            except AutotunerError as error:
                tried.append(f"{protocol}: {error}")
                await self.close()
                continue
            self.device = device
            return [Place("pv", {}), Place("output", {}, writable=True)]
        raise LinkError(
            f"no known protocol answers at {self.device['serial_port']}: {'; '.join(tried)}", remedy=CHECK_LINE
        )


SEARCHES: Final[dict[str, Callable[[SplitResult], Search]]] = {
    "modbus": ModbusSearch,
    "opc.tcp": OpcUaSearch,
    "mqtt": MqttSearch,
    "s7": S7Search,
    "ethernetip": EtherNetIpSearch,
    "epics": EpicsSearch,
    "serial": SerialSearch,
}
"""Searches by the scheme of the address."""


def search_named(address: str) -> Search:
    """Return the search for an address.

    Raises
    ------
    InputError
        The address is of a protocol that cannot be searched, or lacks what its search needs.
    """
    parts = urlsplit(address)
    make = SEARCHES.get(parts.scheme)
    if make is None or not (parts.hostname or parts.scheme == "serial"):
        raise InputError(
            "is not an address that can be searched",
            field="address",
            value=address,
            remedy=f"Write one of {', '.join(f'{scheme}://HOST' for scheme in SEARCHES)}, or serial:///dev/ttyACM0.",
        )
    return make(parts)
