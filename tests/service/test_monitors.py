"""A loop that is watched over HTTP, in virtual time: the simulated device runs under its own controller."""

import asyncio
import copy
from pathlib import Path

import pytest

from tests.service.conftest import HEATER

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

WINDOW_S = 240.0
QUICK = {"check": False, "structure": "fopdt", "rule": "simc_pi"}
GAINS = {"form": "ideal"}
DEVICE = HEATER["device"] | {"auto": True, "gains": {"kp": 1.4, "ti": 8.0, "td": 0.0}}


@pytest.fixture
def watched(serving, configure):
    """Return a function that tunes a loop, has its gains applied, and watches it."""

    def start(**device):
        loop = HEATER | {"gains": GAINS, "device": DEVICE | device}
        return serving(configure({"heater": loop, "other": copy.deepcopy(HEATER)}))

    return start


async def tuned(client):
    made = (await client.post("/v1/loops/heater/tunings", json=QUICK)).json()
    await client.get(made["links"]["events"])
    return made["id"]


async def told_by_readings(client):
    return {reading["loop"]: reading["watch"] for reading in (await client.get("/v1/readings")).json()["readings"]}


async def judged(client, periods=40):
    """Wait for a judgement, moving the time on; return what is told."""
    for _ in range(periods):
        await asyncio.sleep(WINDOW_S / 4.0)
        told = (await client.get("/v1/loops/heater/monitor")).json()
        if told["findings"] is not None:
            return told
    raise AssertionError(told)


async def test_a_loop_that_does_as_promised(watched):
    async with watched() as service:
        client = service.client
        assert (await client.get("/v1/loops/heater/monitor")).json()["state"] == "off"
        tuning = await tuned(client)
        begun = (await client.post("/v1/loops/heater/monitor", json={"window_s": WINDOW_S})).json()
        assert (begun["state"], begun["tuning_id"], begun["findings"]) == ("watching", tuning, None)
        told = await judged(client)
        assert told["findings"]["code"] in {"at_rest", "as_expected"}
        assert told["trouble"] is None
        assert await told_by_readings(client) == {"heater": told["findings"]["code"], "other": None}
        assert (await client.delete("/v1/loops/heater/monitor")).json()["state"] == "off"
        assert (await client.get("/v1/loops/heater/monitor")).json()["state"] == "off"


async def test_watching_writes_nothing_and_gives_way_to_a_tuning(watched):
    async with watched() as service:
        client = service.client
        await tuned(client)
        device = service.manager._backends["heater"]
        written = []
        real = device.write

        async def write(values):
            written.append(values)
            await real(values)

        device.write = write
        await client.post("/v1/loops/heater/monitor", json={"window_s": WINDOW_S})
        await judged(client)
        assert written == []
        made = (await client.post("/v1/loops/heater/tunings", json=QUICK)).json()
        await asyncio.sleep(5.0)
        told = (await client.get("/v1/loops/heater/monitor")).json()
        assert told["trouble"] == "a tuning holds the loop. Monitoring continues after it."
        await client.get(made["links"]["events"])
        assert (await client.get(made["links"]["self"])).json()["verdict"]["outcome"] == "done"
        await asyncio.sleep(WINDOW_S)
        assert (await client.get("/v1/loops/heater/monitor")).json()["trouble"] is None


async def test_what_cannot_be_watched_is_refused(watched, check_problem):
    async with watched() as service:
        client = service.client
        check_problem(await client.post("/v1/loops/heater/monitor"), 409, "wrong-state")
        check_problem(await client.post("/v1/loops/nowhere/monitor"), 404, "unknown-loop")
        check_problem(await client.get("/v1/loops/nowhere/monitor"), 404, "unknown-loop")
        check_problem(await client.delete("/v1/loops/nowhere/monitor"), 404, "unknown-loop")
        tuning = await tuned(client)
        for body, code in (({"tuning_id": "none"}, 404), ({"window_s": 1.0}, 422), ({"window_s": 1e9}, 422)):
            assert (await client.post("/v1/loops/heater/monitor", json=body)).status_code == code
        problem = check_problem(
            await client.post("/v1/loops/other/monitor", json={"tuning_id": tuning}), 422, "unusable-value"
        )
        assert problem["field"] == "tuning_id"


async def test_a_link_that_is_dead_is_told_and_comes_back(watched):
    async with watched() as service:
        client = service.client
        await tuned(client)
        await client.post("/v1/loops/heater/monitor", json={"window_s": WINDOW_S})
        device = service.manager._backends["heater"]
        real = device.read

        async def nan(names):
            return {name: float("nan") for name in names}

        device.read = nan
        await asyncio.sleep(10.0)
        assert "vouches" in (await client.get("/v1/loops/heater/monitor")).json()["trouble"]
        device.read = real
        assert (await judged(client))["trouble"] is None


async def test_a_visit_that_is_ended_by_others_ends_no_monitor(watched):
    async with watched() as service:
        client, manager = service.client, service.manager
        await tuned(client)
        await client.post("/v1/loops/heater/monitor", json={"window_s": WINDOW_S})
        device = manager._backends["heater"]
        real = device.read

        async def slow(names):
            await asyncio.sleep(1.0)
            return await real(names)

        device.read = slow
        await asyncio.sleep(5.0)
        for _ in range(5):
            await manager._visits["heater"].clear()
            await asyncio.sleep(0.7)
        device.read = real
        assert (await judged(client))["findings"] is not None


async def test_a_service_that_starts_again_watches_on(configure, serving):
    configuration = configure({"heater": HEATER | {"gains": GAINS, "device": DEVICE}, "other": copy.deepcopy(HEATER)})
    async with serving(configuration) as service:
        tuning = await tuned(service.client)
        begun = (await service.client.post("/v1/loops/heater/monitor", json={"window_s": WINDOW_S})).json()
    async with serving(configuration) as service:
        told = (await service.client.get("/v1/loops/heater/monitor")).json()
        assert (told["state"], told["tuning_id"], told["window_s"]) == ("watching", tuning, begun["window_s"])
        assert (await judged(service.client))["findings"]["code"] in {"at_rest", "as_expected"}
        await service.client.delete("/v1/loops/heater/monitor")
    async with serving(configuration) as service:
        assert (await service.client.get("/v1/loops/heater/monitor")).json()["state"] == "off"


LEADING_NOWHERE = (
    "{",
    '{"heater": {"tuning_id": "gone", "window_s": 9}}',
    '{"nobody": {"tuning_id": "a", "window_s": 9}}',
)


@pytest.fixture(params=LEADING_NOWHERE)
def spoilt(request, configure):
    """Return a configuration beside whose data a list stands that leads nowhere."""
    configuration = configure({"heater": copy.deepcopy(HEATER)})
    file = Path(configuration.service.data_directory) / "watched.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(request.param, encoding="utf-8")
    return configuration


async def test_a_list_that_leads_nowhere_keeps_no_service_from_starting(spoilt, serving, caplog):
    async with serving(spoilt) as service:
        assert (await service.client.get("/v1/loops/heater/monitor")).json()["state"] == "off"
    assert "watched" in caplog.text
