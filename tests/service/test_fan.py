"""Many who watch one tuning: encoded once, and whoever is slow keeps nobody waiting."""

import asyncio

import pytest

from autotuner.service import fan

pytestmark = pytest.mark.virtual_time

EVENTS = "/v1/tunings/tuning-1/events"


class Watcher:
    """An ASGI client whose connection takes nothing while `jammed`."""

    def __init__(self, app):
        self.body, self.jammed, self.gone = b"", False, asyncio.Event()
        self.freed = asyncio.Event()
        scope = {"type": "http", "http_version": "1.1", "method": "GET", "scheme": "http", "path": EVENTS}
        scope |= {
            "raw_path": EVENTS.encode(),
            "query_string": b"",
            "root_path": "",
            "headers": [(b"host", b"localhost")],
        }
        scope |= {"asgi": {"version": "3.0", "spec_version": "2.3"}, "client": ("127.0.0.1", 50000)}
        self.task = asyncio.create_task(app(scope, self._receive, self._send))

    async def _receive(self):
        await self.gone.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message):
        if self.jammed:
            await self.freed.wait()
        self.body += message.get("body", b"")


@pytest.fixture
def encodings(monkeypatch):
    """Return the indices of the events in the order in which they are encoded."""
    seen, encode = [], fan._encoded

    def note(index, event):
        seen.append(index)
        return encode(index, event)

    monkeypatch.setattr(fan, "_encoded", note)
    return seen


async def test_what_happens_is_encoded_once_for_all(serving, encodings):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        watchers = [Watcher(service.app) for _ in range(5)]
        await asyncio.sleep(1.0)
        before = len(service.manager.tuning("tuning-1").events)
        encodings.clear()
        await asyncio.gather(*(watcher.task for watcher in watchers))
    assert encodings == sorted(set(encodings))
    assert set(range(before + 1, encodings[-1] + 1)) <= set(encodings)
    assert len({watcher.body for watcher in watchers}) == 1


async def test_a_slow_viewer_keeps_nobody_waiting_and_misses_nothing(serving, read_events):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        quick, slow = Watcher(service.app), Watcher(service.app)
        await asyncio.sleep(2.0)
        slow.jammed = True
        held = len(slow.body)
        await quick.task
        assert len(slow.body) == held
        slow.jammed = False
        slow.freed.set()
        await slow.task
    told = [read_events(watcher.body.decode()) for watcher in (quick, slow)]
    assert told[0] == told[1]
    assert [index for index, _, _ in told[1]] == list(range(len(told[1])))


async def test_a_viewer_whose_connection_fails_takes_nobody_along(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        good, bad = Watcher(service.app), Watcher(service.app)
        await asyncio.sleep(2.0)

        async def broken(_message):
            raise OSError("broken")

        next(iter(service.app.state.fans._fans["tuning-1"]._viewers)).line = fan.Line(broken)
        await asyncio.wait([good.task, bad.task], return_when=asyncio.FIRST_COMPLETED)
        assert service.manager.running("heater") is not None
        rest = bad if good.task.done() else good
        await rest.task
    assert b"event: ended" in rest.body


async def test_when_nobody_watches_any_more_nothing_is_left(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        watcher = Watcher(service.app)
        await asyncio.sleep(1.0)
        assert service.app.state.fans._fans
        watcher.gone.set()
        await watcher.task
        assert not service.app.state.fans._fans
        assert not [task for task in asyncio.all_tasks() if task.get_name().startswith("viewers-")]
