"""The service with its loops in a thread of their own: what keeps the one busy does not keep the other waiting."""

import gc
import signal
import sys

import httpx
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.floor import OwnThread
from autotuner.cli import main
from autotuner.service import serve
from autotuner.service.app import create_app
from autotuner.stopped_by import stopped_by
from tests.control.processes import until

pytestmark = pytest.mark.realtime

FAST = {
    "driver": "simulated",
    "sample_time_s": 0.02,
    "limits": {"output": [0.0, 100.0]},
    "relay": {"amplitude": 10.0, "quiet_s": 0.5, "min_periods": 500, "max_periods": 1000},
    "device": {"plant": {"structure": "fopdt", "K": 2.0, "T": 0.5, "D": 0.2}, "output0": 40.0, "pv0": 80.0},
}


class CountingFloor(OwnThread):
    """Counts what is done on it."""

    done = 0

    async def run(self, work):
        self.done += 1
        return await super().run(work)


@pytest.fixture
async def service(configure):
    """The running application on a floor of its own, with a client; its loop is looked at for long before it moves."""
    calm = FAST | {"relay": FAST["relay"] | {"quiet_s": 10.0}}
    app = create_app(configure({"fast": calm}), InPlace(), floor=CountingFloor())
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost:8321") as client,
    ):
        yield app, client


async def test_a_blocked_request_makes_no_sample_wait(service):
    """The event loop of the requests is blocked until ten more samples have been taken: it would wait for ever."""
    app, client = service
    path = (await client.post("/v1/loops/fast/tunings")).headers["location"]
    tuning = app.state.manager.newest_first()[0]

    @app.get("/hog")
    async def hog() -> bool:
        wanted = len(tuning.samples) + 10
        return until(lambda: len(tuning.samples) >= wanted)

    assert (await client.get("/hog")).json() is True
    ended = await client.post(f"{path}/abort")
    assert ended.status_code == 202
    events = (await client.get(f"{path}/events")).text
    assert '"code": "requested"' in events
    assert (await client.get(path)).json()["restored"] is True


async def test_requests_that_only_look_take_no_turn_on_the_floor(service):
    app, client = service
    path = (await client.post("/v1/loops/fast/tunings")).headers["location"]
    done = app.state.floor.done
    for looked_at in (path, "/v1/loops", "/v1/loops/fast", "/v1/tunings", "/healthz"):
        assert (await client.get(looked_at)).status_code == 200
    assert (await client.get("/v1/loops")).json()["loops"][0]["tuning_id"] == path.rpartition("/")[2]
    assert app.state.floor.done == done


async def test_requests_that_touch_a_loop_are_done_on_the_floor(service):
    _, client = service
    key = {"Idempotency-Key": "one-start"}
    first = await client.post("/v1/loops/fast/tunings", headers=key)
    again = await client.post("/v1/loops/fast/tunings", headers=key)
    other = await client.post("/v1/loops/fast/tunings")
    assert (first.status_code, again.status_code, other.status_code) == (202, 202, 409)
    assert first.json()["id"] == again.json()["id"] == other.json()["tuning_id"]
    assert (await client.get("/v1/loops/fast")).json()["tuning_id"] == first.json()["id"]
    assert (await client.get("/v1/loops/fast/gains")).status_code in {409, 422}
    assert (await client.get("/v1/loops/none")).status_code == 404
    assert (await client.get("/v1/readings")).json()["readings"][0]["tuning_id"] == first.json()["id"]


async def test_the_end_of_the_application_gives_the_loops_back(configure):
    app = create_app(configure({"fast": FAST}), InPlace(), floor=OwnThread())
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost:8321") as client,
    ):
        await client.post("/v1/loops/fast/tunings")
        tuning = app.state.manager.newest_first()[0]
        while not any(sample.output > 45.0 for sample in list(tuning.samples)):
            await client.get("/v1/loops")
    assert (tuning.verdict.code, tuning.controller.restored) == ("shutdown", True)


@pytest.fixture
def handlers():
    """Put back what serving does with the signals and the collector of its process."""
    kept = {number: signal.getsignal(number) for number in stopped_by()}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)
    gc.unfreeze()


def test_the_service_ends_when_the_thread_of_the_loops_breaks_down(handlers, monkeypatch, tmp_path, capfd):
    class Breaking(OwnThread):
        def open(self, rescue):
            super().open(rescue)
            self._loop.call_soon_threadsafe(sys.exit, 3)

    monkeypatch.setattr(serve, "OwnThread", Breaking)
    file = tmp_path / "loops.toml"
    file.write_text(
        '[loops.fast]\ndriver = "simulated"\ndevice = { plant = { structure = "fopdt", K = 2.0, T = 0.5, D = 0.2 } }\n'
    )
    assert main(["serve", "--json", "--port", "0", "--config", str(file)]) == 1
    assert "the thread of the loops broke down" in capfd.readouterr().err
