"""The live stream as a browser sees it: piece by piece, broken off, taken up again."""

import asyncio
import json

import jsonschema_rs
import pytest

from autotuner.service.openapi import document

pytestmark = pytest.mark.virtual_time

EVENTS = "/v1/tunings/tuning-1/events"


class Reader:
    """An ASGI client that notes when each piece arrives, and goes away when it is told to."""

    def __init__(self, app, path):
        self.pieces = []
        self.gone = asyncio.Event()
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": "GET",
            "scheme": "http",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": [(b"host", b"localhost")],
            "client": ("127.0.0.1", 50000),
            "server": ("127.0.0.1", 8321),
        }
        self._asked = False
        self.task = asyncio.create_task(app(scope, self._receive, self._send))

    async def _receive(self):
        if not self._asked:
            self._asked = True
            return {"type": "http.request", "body": b"", "more_body": False}
        await self.gone.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message):
        if message["type"] == "http.response.body":
            self.pieces.append((asyncio.get_running_loop().time(), message["body"].decode()))


async def test_every_event_is_as_documented(serving, read_events):
    event = jsonschema_rs.validator_for({**json.loads(document()), "$ref": "#/components/schemas/Event"})
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        events = read_events((await service.client.get(EVENTS)).text)
    for _, _, data in events:
        event.validate(data)
    assert {name for _, name, _ in events} >= {"sample", "phase", "estimate", "restored", "ended"}


async def test_events_arrive_as_they_happen(serving, read_events):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        reader = Reader(service.app, EVENTS)
        begun = asyncio.get_running_loop().time()
        await reader.task
    arrived = [
        (at - begun, data) for at, piece in reader.pieces for _, name, data in read_events(piece) if name == "sample"
    ]
    assert len(arrived) > 500
    assert all(at == pytest.approx(data["t"], abs=1e-6) for at, data in arrived)


async def test_a_reader_that_goes_away_leaves_nothing_and_disturbs_nobody(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        reader = Reader(service.app, EVENTS)
        await asyncio.sleep(3.05)
        seen = len(reader.pieces)
        reader.gone.set()
        await reader.task
        await asyncio.sleep(3.0)
        assert seen == len(reader.pieces) == pytest.approx(31, abs=3)
        assert service.manager.running("heater") is not None


async def test_a_broken_stream_goes_on_where_it_was(serving, read_events):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        whole = read_events((await service.client.get(EVENTS)).text)
        rest = await service.client.get(EVENTS, headers={"Last-Event-ID": "99"})
        last = await service.client.get(EVENTS, headers={"Last-Event-ID": str(whole[-2][0])})
        over = await service.client.get(EVENTS, headers={"Last-Event-ID": str(whole[-1][0])})
    assert read_events(rest.text) == whole[100:]
    assert read_events(last.text) == whole[-1:]
    assert over.status_code == 204
    assert over.content == b""


async def test_a_stream_taken_up_in_the_middle_of_a_tuning(serving, read_events):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        await asyncio.sleep(5.0)
        known = len(service.manager.tuning("tuning-1").events)
        rest = await service.client.get(EVENTS, headers={"Last-Event-ID": str(known - 1)})
        everything = service.manager.tuning("tuning-1").events
    assert [data for _, _, data in read_events(rest.text)] == [event.to_dict() for event in everything[known:]]


@pytest.mark.parametrize("value", ["first", "-2", "1.5", ""])
async def test_an_index_that_is_none(serving, check_problem, value):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        answer = await service.client.get(EVENTS, headers={"Last-Event-ID": value})
    assert check_problem(answer, 422, "unusable-value")["field"] == "Last-Event-ID"
