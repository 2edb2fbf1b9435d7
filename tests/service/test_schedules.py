"""Gains for several operating points: one request, on a simulated device with its own controller."""

import asyncio

import pytest

from autotuner.errors import StorageError
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from tests.service.conftest import HEATER

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

POINTS = [70.0, 90.0]
ASKED = {"set_points": POINTS, "check": False, "structure": "fopdt", "rule": "simc_pi"}


@pytest.fixture
def loops():
    def make(**device):
        return {"heater": HEATER | {"device": HEATER["device"] | {"auto": True} | device}}

    return make


async def started(client, **body):
    answer = await client.post("/v1/loops/heater/schedules", json=ASKED | body)
    assert answer.status_code == 202, answer.text
    return answer.headers["location"]


async def ended(client, path):
    for _ in range(200):
        told = (await client.get(path)).json()
        if told["state"] == "ended":
            return told
        await asyncio.sleep(5.0)
    raise AssertionError(f"the run does not end: {told}")


async def held(service):
    backend = service.manager.device("heater")[1]
    await backend.open()
    seen = await backend.read([SET_POINT, AUTO, OUTPUT])
    await backend.close()
    return seen


async def test_the_gains_of_two_points_make_a_schedule_and_the_set_point_goes_back(serving, configure, loops):
    async with serving(configure(loops())) as service:
        told = await ended(service.client, await started(service.client))
        assert told["verdict"]["code"] == "scheduled", told["verdict"]
        schedule = told["schedule"]
        assert [row["value"] for row in schedule["rows"]] == POINTS
        assert (schedule["borders"], schedule["hysteresis"]) == ([80.0], 2.0)
        # the plant is the same at both points
        low, high = (row["gains"]["Kp"] for row in schedule["rows"])
        assert low == pytest.approx(high, rel=0.1)
        for tuning_id, output in zip(told["tuning_ids"], (35.0, 45.0), strict=True):
            tuning = (await service.client.get(f"/v1/tunings/{tuning_id}")).json()
            assert tuning["before"]["output"] == pytest.approx(output, abs=1.0)
        seen = await held(service)
        assert (seen[SET_POINT], seen[AUTO]) == (80.0, 1.0)
        by_output = await service.client.post("/v1/schedules", json={"tuning_ids": told["tuning_ids"]})
        values = [row["value"] for row in by_output.json()["rows"]]
        assert values == pytest.approx([35.0, 45.0], abs=1.0)


async def test_an_abort_in_the_middle_gives_output_and_set_point_back(serving, configure, loops):
    async with serving(configure(loops())) as service:
        path = await started(service.client)
        run = service.manager.schedules.run(path.rpartition("/")[2])
        for _ in range(300):
            await asyncio.sleep(1.0 if not run.tunings else 0.0)
        await asyncio.sleep(25.0)
        assert (await service.client.post(f"{path}/abort")).status_code == 202
        told = await ended(service.client, path)
        assert (told["verdict"]["outcome"], told["schedule"]) == ("aborted", None)
        tuning = (await service.client.get(f"/v1/tunings/{told['tuning_ids'][0]}")).json()
        assert (tuning["state"], tuning["restored"]) == ("ended", True)
        seen = await held(service)
        assert (seen[SET_POINT], seen[AUTO]) == (80.0, 1.0)


async def test_the_service_ends_a_run_when_it_stops(serving, configure, loops):
    async with serving(configure(loops())) as service:
        path = await started(service.client)
        await asyncio.sleep(40.0)
        backend = service.manager.device("heater")[1]
        run = service.manager.schedules.run(path.rpartition("/")[2])
    assert run.verdict.outcome == "aborted"
    await backend.open()
    assert (await backend.read([SET_POINT]))[SET_POINT] == 80.0


@pytest.mark.long  # a disk that fills ends it the same way
async def test_a_point_without_gains_ends_the_run(serving, configure, loops):
    """So much noise that the relay's answer is not seen in it."""
    async with serving(configure(loops(noise=8.0))) as service:
        told = await ended(service.client, await started(service.client))
        assert told["verdict"]["code"] in {"point_failed", "not_at_rest"}
        assert (told["schedule"], (await held(service))[SET_POINT]) == (None, 80.0)


async def test_a_disk_that_has_filled_ends_the_run_and_is_named(serving, configure, loops, monkeypatch):
    def full(*_, **__):
        raise StorageError("cannot be written: no space is left", remedy="Make room.")

    async with serving(configure(loops())) as service:
        monkeypatch.setattr(type(service.manager), "start", full)
        told = await ended(service.client, await started(service.client))
        assert (told["verdict"]["code"], (await held(service))[SET_POINT]) == ("storage_error", 80.0)


async def test_while_it_runs_no_other_run_is_started(serving, configure, loops, check_problem):
    async with serving(configure(loops())) as service:
        path = await started(service.client)
        second = await service.client.post("/v1/loops/heater/schedules", json={"set_points": POINTS})
        check_problem(second, 409, "wrong-state")
        await service.client.post(f"{path}/abort")
        await ended(service.client, path)


async def test_refused_before_anything_is_moved(serving, configure, loops, check_problem):
    async with serving(configure(loops())) as service:
        for points in ([70.0, 70.0], [70.0, 400.0]):
            refused = await service.client.post("/v1/loops/heater/schedules", json={"set_points": points})
            check_problem(refused, 422, "unusable-value")
        check_problem(await service.client.get("/v1/schedules/none"), 404, "unknown-schedule")
    async with serving(configure(loops(auto=False))) as service:
        told = await ended(service.client, await started(service.client))
        assert "manual" in told["verdict"]["message"]
