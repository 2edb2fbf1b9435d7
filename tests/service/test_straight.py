"""The straight way to a connection: chunks as another's reader takes them apart, and when there is none."""

import asyncio
from types import SimpleNamespace

import h11
import pytest
import uvicorn
from uvicorn.server import ServerState

from autotuner.service.straight import chunk, straight

pytestmark = pytest.mark.virtual_time

HTTP = {"type": "http", "http_version": "1.1"}


class Request:
    """What uvicorn shows of a request, with a connection that keeps what it is given."""

    def __init__(self):
        self.written, self.disconnected = b"", False
        self.transport, self.flow = SimpleNamespace(write=self._take), SimpleNamespace(write_paused=False)

    def _take(self, data):
        self.written += data

    async def send(self, message):
        raise AssertionError(message)


def test_chunks_are_those_of_http():
    """The judge: the reader of h11."""
    reader = h11.Connection(h11.CLIENT)
    reader.send(h11.Request(method="GET", target="/", headers=[("Host", "a")]))
    reader.send(h11.EndOfMessage())
    pieces = [b"a", b"x" * 300, b"", b"\r\n0\r\n\r\n", bytes(range(256))]
    reader.receive_data(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"".join(map(chunk, pieces)))
    events = []
    while (event := reader.next_event()) is not h11.NEED_DATA:
        events.append(event)
    assert b"".join(bytes(event.data) for event in events[1:]) == b"".join(pieces)
    reader.receive_data(b"0\r\n\r\n")
    assert isinstance(reader.next_event(), h11.EndOfMessage)


async def test_it_writes_until_the_connection_takes_no_more_or_has_ended():
    request = Request()
    write = straight(HTTP, request.send)
    assert write(b"one")
    request.flow.write_paused = True
    assert not write(b"two")
    request.flow.write_paused, request.disconnected = False, True
    assert write(b"three")
    assert request.written == b"one"


@pytest.mark.parametrize("scope", [HTTP | {"http_version": "1.0"}, HTTP | {"http_version": "2"}, {"type": "lifespan"}])
def test_without_chunks_there_is_no_straight_way(scope):
    assert straight(scope, Request().send) is None


def test_a_server_that_shows_no_connection_gets_the_usual_way():
    async def send(_message):
        await asyncio.sleep(0)

    assert straight(HTTP, send) is None


async def test_the_server_in_use_has_a_straight_way():
    """Uvicorn's own protocol over a connection in memory: both ways follow each other in one answer."""
    ended, ways = asyncio.Event(), []

    async def application(scope, _receive, send):
        ways.append(straight(scope, send))
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for k in range(3):
            assert ways[0](chunk(b"straight %d " % k))
            await send({"type": "http.response.body", "body": b"usual %d " % k, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})
        ended.set()

    settings = uvicorn.Config(application, lifespan="off", log_config=None)
    settings.load()
    protocol, line = settings.http_protocol_class(settings, ServerState(), {}), Connection()
    protocol.connection_made(line)
    protocol.data_received(b"GET / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
    await ended.wait()
    protocol.connection_lost(None)
    client = h11.Connection(h11.CLIENT)
    client.send(h11.Request(method="GET", target="/", headers=[("Host", "a")]))
    client.send(h11.EndOfMessage())
    client.receive_data(line.written)
    events = []
    while type(event := client.next_event()) is not h11.EndOfMessage:
        events.append(event)
    told = b"".join(bytes(event.data) for event in events[1:])
    assert told == b"".join(b"straight %d usual %d " % (k, k) for k in range(3))


class Connection(asyncio.Transport):
    """A connection in memory."""

    def __init__(self):
        super().__init__({"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 2)})
        self.written = b""

    def write(self, data):
        self.written += data

    def is_closing(self):
        return False

    def close(self):
        pass
