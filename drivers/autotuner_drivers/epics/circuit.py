"""One Channel Access circuit: a TCP connection to a server, its channels, and the search for the server of a channel.

The library caproto encodes the messages and defines their order; it is sans-IO. This module owns the sockets.
Source: Channel Access Protocol Specification, EPICS base 3.15; port 5064.

Invariants:

1. A response belongs to its request by its number, so requests may overlap and a late response is dropped.
2. A lost circuit fails all pending requests at once, calls `on_lost`, and is never used again.
"""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import socket
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import DeviceRefusedError, LinkError
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.options import import_extra

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

VERSION: Final = 13
"""Version of the protocol that is offered, EPICS 3.14 and later."""
CHUNK: Final = 65536
"""Bytes of one read of the connection: several messages of the protocol."""
FIRST_REPEAT_S: Final = 0.05
"""A search is repeated after this, then after twice as long, and so on: UDP loses datagrams."""
UNKNOWN_CHANNEL: Final = "Check the name with `caget NAME`, and that the IOC at this address serves the record."


class Circuit:
    """A connection to one server.

    Parameters
    ----------
    address : tuple of str and int
        Host and TCP port of the server.
    on_lost : callable
        Called with the reason when the server closes the connection.
    """

    def __init__(self, address: tuple[str, int], on_lost: Callable[[str], None]) -> None:
        self._ca = import_extra("epics", "caproto")
        self._address, self._on_lost = address, on_lost
        self._state: Any = self._ca.VirtualCircuit(our_role=self._ca.CLIENT, address=address, priority=0)
        self._channels: dict[str, Any] = {}
        self._awaited: dict[object, asyncio.Future[Any]] = {}
        self._writer: asyncio.StreamWriter | None = None
        self._receiving: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Connect, and exchange versions."""
        ca = self._ca
        reader, self._writer = await asyncio.open_connection(*self._address)
        self._state.our_address = self._writer.get_extra_info("sockname")
        self._receiving = asyncio.ensure_future(self._receive(reader))
        await self._answer(
            "version",
            ca.VersionRequest(0, VERSION),
            ca.HostNameRequest(socket.gethostname()),
            ca.ClientNameRequest(_user()),
        )

    async def close(self) -> None:
        """Close the connection."""
        receiving, self._receiving = self._receiving, None
        if receiving is not None:
            receiving.cancel()
            await asyncio.gather(receiving, return_exceptions=True)
        if self._writer is not None:
            self._writer.close()
            with contextlib.suppress(OSError):
                await self._writer.wait_closed()
        self._fail("the connection was closed")

    async def create(self, name: str) -> Any:
        """Return the channel of a name, with its data type and access rights; created once.

        Raises
        ------
        DeviceRefusedError
            The server has no such channel.
        """
        if name not in self._channels:
            channel = self._ca.ClientChannel(name, self._state)
            self._channels[name] = channel
            created = await self._answer(("channel", channel.cid), channel.create())
            if not isinstance(created, self._ca.CreateChanResponse):
                raise DeviceRefusedError(
                    "is not a channel of this server", field="name", value=name, remedy=UNKNOWN_CHANNEL
                )
        return self._channels[name]

    async def read(self, channel: Any, data_type: int) -> Any:
        """Return the first element of a channel, with the metadata of the requested data type."""
        request = channel.read(data_type=self._ca.ChannelType(data_type), data_count=1)
        return await self._answer(request.ioid, request)

    async def write(self, channel: Any, raw: float | bytes) -> None:
        """Write the first element of a channel; return once the records that it triggers have been processed."""
        request = channel.write([raw], data_count=1, notify=True)
        await self._answer(request.ioid, request)

    async def _answer(self, key: object, *requests: Any) -> Any:
        """Send requests and return the answer to the last one."""
        if self._writer is None or self._receiving is None:
            raise LinkError("the circuit is not connected", remedy=CHECK_LINE)
        response = self._awaited[key] = asyncio.get_running_loop().create_future()
        try:
            self._writer.writelines(bytes(part) for part in self._state.send(*requests))
            answer = await response
        finally:
            self._awaited.pop(key, None)
        status = getattr(answer, "status", None)
        if status is not None and not status.success:
            raise DeviceRefusedError(
                f"the server answered {status.name} ({status.description})",
                remedy="Check the access rights of the record, and whether it takes this data type.",
            )
        return answer

    async def _receive(self, reader: asyncio.StreamReader) -> None:
        reason = "the server closed the connection"
        try:
            while data := await reader.read(CHUNK):
                for message in self._state.recv(data)[0]:
                    self._state.process_command(message)
                    self._resolve(message)
        except Exception as error:  # noqa: BLE001 - whatever the library makes of damaged bytes
            reason = f"the connection failed: {type(error).__name__}: {error}"
        self._receiving = None
        self._fail(reason)
        self._on_lost(reason)

    def _resolve(self, message: Any) -> None:
        """Resolve the request that a response belongs to; drop a response without a request."""
        ca = self._ca
        if isinstance(message, ca.ServerDisconnResponse):  # a record was removed: the channel must be created again
            raise ca.CaprotoError("the server has removed a channel")
        key: object = getattr(message, "ioid", None)
        if isinstance(message, ca.VersionResponse):
            key = "version"
        elif isinstance(message, ca.CreateChanResponse | ca.CreateChFailResponse):
            key = ("channel", message.cid)
        elif isinstance(message, ca.ErrorResponse):
            key = message.original_request.parameter2
        answered = self._awaited.get(key)
        if answered is not None and not answered.done():
            answered.set_result(message)

    def _fail(self, reason: str) -> None:
        for response in self._awaited.values():
            if not response.done():
                response.set_exception(LinkError(reason, remedy=CHECK_LINE))


async def search(names: Sequence[str], address: tuple[str, int], limit_s: float) -> dict[str, tuple[str, int]]:
    """Return the server of each channel that is found within `limit_s` at an IOC, a gateway or a broadcast address."""
    ca, loop = import_extra("epics", "caproto"), asyncio.get_running_loop()
    found: dict[str, tuple[str, int]] = {}
    every = loop.create_future()
    broadcaster = ca.Broadcaster(our_role=ca.CLIENT)
    requests = {cid: ca.SearchRequest(name, cid, VERSION) for cid, name in enumerate(names)}

    class Answers(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, sender: tuple[str | Any, int]) -> None:
            for message in broadcaster.recv(data, sender):
                if isinstance(message, ca.SearchResponse) and message.cid < len(names):
                    found.setdefault(names[message.cid], ca.extract_address(message))
            if len(found) == len(requests) and not every.done():
                every.set_result(None)

    transport, _ = await loop.create_datagram_endpoint(Answers, family=socket.AF_INET, allow_broadcast=True)
    broadcaster.client_address = transport.get_extra_info("sockname")
    wait_s, end_s = FIRST_REPEAT_S, loop.time() + limit_s
    try:
        while not every.done() and loop.time() < end_s:
            missing = [request for cid, request in requests.items() if names[cid] not in found]
            transport.sendto(bytes(broadcaster.send(ca.VersionRequest(0, VERSION), *missing)), address)
            await asyncio.wait([every], timeout=min(wait_s, limit_s))
            wait_s *= 2.0
    finally:
        transport.close()
    return found


def _user() -> str:
    """Return the user name for access rights; empty where the operating system reports none."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "autotuner"
