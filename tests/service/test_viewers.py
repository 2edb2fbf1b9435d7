"""Many viewers of one tuning: a slow one, a broken one and one that leaves disturb nobody."""

import asyncio

import pytest

pytestmark = pytest.mark.virtual_time

EVENTS = "/v1/tunings/tuning-1/events"


class Watcher:
    """An ASGI client whose connection takes nothing while `jammed`."""

    def __init__(self, app):
        self.body, self.jammed, self.broken, self.gone = b"", False, False, asyncio.Event()
        self.freed, self._asked = asyncio.Event(), False
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
        if not self._asked:
            self._asked = True
            return {"type": "http.request", "body": b"", "more_body": False}
        await self.gone.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message):
        if self.broken:
            raise OSError("broken")
        if self.jammed:
            await self.freed.wait()
        self.body += message.get("body", b"")


async def test_many_viewers_read_the_same(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        watchers = [Watcher(service.app) for _ in range(5)]
        await asyncio.gather(*(watcher.task for watcher in watchers))
    assert b"event: ended" in watchers[0].body
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
        bad.broken = True
        with pytest.raises(OSError, match="broken"):
            await bad.task
        assert service.manager.running("heater") is not None
        await good.task
    assert b"event: ended" in good.body


async def test_a_viewer_that_leaves_ends_its_stream(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        await asyncio.sleep(0.5)
        before = len(asyncio.all_tasks())
        watcher = Watcher(service.app)
        await asyncio.sleep(1.0)
        assert len(asyncio.all_tasks()) > before
        watcher.gone.set()
        await watcher.task
        assert len(asyncio.all_tasks()) == before
