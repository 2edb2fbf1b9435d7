"""The clients against the service itself, and against answers that no service of ours would give."""

import json

import httpx
import pytest

from autotuner.client import AsyncClient, Client, ServiceError, StreamError
from autotuner.core.recording import Recording


@pytest.fixture
def of(serving):
    """Return an asynchronous client of a running service in memory."""

    def make(service):
        transport = httpx.ASGITransport(service.app)
        return AsyncClient("http://localhost:8321", http=httpx.AsyncClient(transport=transport))

    return make


@pytest.mark.usefixtures("without_diagnosis")
@pytest.mark.virtual_time
async def test_a_tuning_from_start_to_gains(serving, of):
    async with serving() as service, of(service) as client:
        assert (await client.healthz()).status == "ok"
        assert {loop.name for loop in (await client.list_loops()).loops} == {"heater", "furnace"}
        assert (await client.plan_tuning("heater", 40.0)).amplitude == 10.0
        tuning = await client.tune("heater", check=False)
        assert tuning.verdict.code == "identified"
        assert tuning.gains.Kp == pytest.approx(tuning.tuning.gains.Kp)
        recording = Recording.from_csv_text(await client.get_recording(tuning.id))
        assert len(recording) == tuning.samples
        other = await client.compute_gains(tuning.id, goal="brisk")
        assert other.goal == "brisk"
        events = [event async for event in client.follow_tuning(tuning.id)]
        assert [event["type"] for event in events].count("sample") == tuning.samples
        behind = [event async for event in client.follow_tuning(tuning.id, len(events) - 3)]
        assert behind == events[-2:]
        assert [row.id for row in (await client.list_tunings("heater", 5)).tunings] == [tuning.id]
        with pytest.raises(ServiceError) as refusal:
            await client.get_loop("none")
    assert refusal.value.status == 404
    assert refusal.value.type == "/v1/problems#unknown-loop"
    assert "heater" in refusal.value.remedy


@pytest.mark.virtual_time
async def test_a_start_that_is_sent_twice_is_done_once(serving, of):
    async with serving() as service, of(service) as client:
        first = await client.start_tuning("furnace", "key-12345")
        again = await client.start_tuning("furnace", "key-12345")
        assert first.id == again.id
        assert (await client.abort_tuning(first.id)).id == first.id


def answering(*answers):
    """Return a client whose requests are answered one by one, and the requests."""
    given, seen = iter(answers), []

    def handle(request):
        seen.append(request)
        answer = next(given)
        if isinstance(answer, Exception):
            raise answer
        return answer

    return Client("http://service", "secret", http=httpx.Client(transport=httpx.MockTransport(handle))), seen


class Broken(httpx.SyncByteStream):
    """A body that breaks off."""

    def __init__(self, *pieces):
        self.pieces = pieces

    def __iter__(self):
        yield from self.pieces
        raise httpx.ReadError("broken off")


def event(number, kind="sample"):
    return f"event: {kind}\nid: {number}\ndata: {json.dumps({'type': kind, 't': float(number)})}\n\n".encode()


def test_a_stream_that_breaks_off_is_taken_up_where_it_was():
    first = httpx.Response(200, stream=Broken(event(0), b": still here\n\n", event(1), event(2)[:20]))
    client, seen = answering(
        first, httpx.ConnectError("refused"), httpx.Response(200, content=event(2) + event(3, "ended"))
    )
    events = list(client.follow_tuning("t1"))
    assert [one["t"] for one in events] == [0.0, 1.0, 2.0, 3.0]
    assert [request.headers["last-event-id"] for request in seen] == ["-1", "1", "1"]
    assert {request.headers["authorization"] for request in seen} == {"Bearer secret"}


def test_a_stream_that_always_breaks_off_is_given_up():
    client, seen = answering(*[httpx.ConnectError("refused") for _ in range(10)])
    with pytest.raises(StreamError, match="broke off 6 times"):
        list(client.follow_tuning("t1"))
    assert len(seen) == 6


def test_a_tuning_of_which_everything_was_told_has_no_more_events():
    client, _ = answering(httpx.Response(204))
    assert list(client.follow_tuning("t1", 99)) == []


def test_a_problem_of_a_stream_is_told():
    problem = {"type": "/v1/problems#unknown-tuning", "detail": "no such", "remedy": "List them."}
    told = httpx.Response(404, json=problem, headers={"content-type": "application/problem+json"})
    client, _ = answering(told)
    with pytest.raises(ServiceError, match="no such") as refusal:
        list(client.follow_tuning("t1"))
    assert refusal.value.remedy == "List them."


def test_an_answer_that_is_none_of_ours_is_told():
    client, _ = answering(httpx.Response(502, text="<html>proxy</html>"))
    with pytest.raises(ServiceError, match="answered 502") as refusal:
        client.list_loops()
    assert refusal.value.type == "about:blank"


def test_what_is_not_given_is_not_sent():
    client, seen = answering(httpx.Response(200, json={"tunings": []}))
    client.list_tunings(loop="a b")
    assert str(seen[0].url) == "http://service/v1/tunings?loop=a+b"


def test_only_its_own_connections_are_closed():
    given = httpx.Client()
    with Client("http://service", http=given):
        pass
    assert not given.is_closed
    given.close()
    own = Client("http://service")
    own.close()
    assert own._http.is_closed
