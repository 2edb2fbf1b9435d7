"""Another configuration while the service runs: loops come, change and go; a tuning is never touched."""

import asyncio

import httpx
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import parse_configuration
from autotuner.errors import ConfigurationError
from autotuner.service.app import create_app

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def loops(serving):
    """The tables of the two loops of the tests of the service."""
    from tests.service.conftest import FURNACE, HEATER

    return {"heater": HEATER, "furnace": FURNACE}


class File:
    """The configuration file as it is now."""

    def __init__(self, folder, loops):
        self.folder, self.loops, self.service = folder, dict(loops), {}

    def read(self):
        service = {"data_directory": str(self.folder / "data")} | self.service
        return parse_configuration({"service": service, "loops": self.loops}, "file")


@pytest.fixture
async def running(tmp_path, loops):
    """The file, the application and a client of a running service."""
    file = File(tmp_path, loops)
    app = create_app(file.read(), InPlace(), read_configuration=file.read)
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost:8321") as client,
    ):
        yield file, app, client


async def names(client):
    return {loop["name"] for loop in (await client.get("/v1/loops")).json()["loops"]}


async def test_loops_come_change_and_go(running):
    file, app, client = running
    heater = app.state.manager._backends["heater"]
    file.loops = {
        "heater": file.loops["heater"],
        "furnace": {**file.loops["furnace"], "pv_unit": "K"},
        "oven": file.loops["heater"],
    }
    told = (await client.post("/v1/reload")).json()
    assert told == {"added": ["oven"], "changed": ["furnace"], "removed": [], "held": [], "restart": []}
    assert await names(client) == {"heater", "furnace", "oven"}
    assert (await client.get("/v1/loops/furnace")).json()["pv_unit"] == "K"
    assert app.state.manager._backends["heater"] is heater
    del file.loops["furnace"], file.loops["oven"]
    assert (await client.post("/v1/reload")).json()["removed"] == ["furnace", "oven"]
    assert await names(client) == {"heater"}
    assert (await client.get("/v1/loops/furnace")).status_code == 404


async def test_a_loop_that_is_tuned_stays_as_it_is_until_then(running):
    file, app, client = running
    tuning_id = (await client.post("/v1/loops/heater/tunings", json={"check": False})).json()["id"]
    await asyncio.sleep(10.0)
    file.loops = {"furnace": file.loops["furnace"]}
    told = (await client.post("/v1/reload")).json()
    assert (told["held"], told["removed"]) == (["heater"], [])
    async for _ in app.state.manager.tuning(tuning_id).follow():
        pass
    await asyncio.sleep(1.0)
    tuning = (await client.get(f"/v1/tunings/{tuning_id}")).json()
    assert (tuning["verdict"]["code"], tuning["restored"]) == ("identified", True)
    assert (await client.post("/v1/reload")).json()["removed"] == ["heater"]
    assert (await client.get(f"/v1/tunings/{tuning_id}/report")).status_code == 200


async def test_a_changed_loop_is_tuned_with_its_new_table(running):
    file, _, client = running
    file.loops["heater"] = {**file.loops["heater"], "relay": {"amplitude": 7.5}}
    await client.post("/v1/reload")
    started = (await client.post("/v1/loops/heater/tunings")).json()
    assert started["settings"]["amplitude"] == 7.5


async def test_an_error_in_the_file_changes_nothing(running, check_problem):
    file, _, client = running
    before = (await client.get("/v1/loops")).json()
    file.loops = {"oven": file.loops["heater"], "heater": {**file.loops["heater"], "driver": "none"}}
    problem = check_problem(await client.post("/v1/reload"), 422, "unusable-value")
    assert problem["field"] == "loops.heater.driver"
    file.loops = {"heater": {"driver": "simulated", "sample_time": 1.0}}
    problem = check_problem(await client.post("/v1/reload"), 422, "unusable-value")
    assert "sample_time" in problem["field"]
    assert (await client.get("/v1/loops")).json() == before


async def test_what_needs_a_restart_is_named(running):
    file, app, client = running
    file.service = {"port": 9999, "keep_tunings": 5}
    assert (await client.post("/v1/reload")).json()["restart"] == ["service.port", "service.keep_tunings"]
    assert app.state.manager.configuration.service.keep_tunings != 5


async def test_a_service_without_a_file_says_so(serving, check_problem):
    async with serving() as service:
        problem = check_problem(await service.client.post("/v1/reload"), 422, "unusable-value")
    assert "autotuner serve --config" in problem["remedy"]


async def test_a_look_under_way_does_not_stand_in_the_way(running):
    file, _, client = running
    await client.get("/v1/readings")
    file.loops["heater"] = {**file.loops["heater"], "pv_unit": "K"}
    assert (await client.post("/v1/reload")).json()["changed"] == ["heater"]
    await client.get("/v1/readings")
    await asyncio.sleep(2.0)
    readings = (await client.get("/v1/readings?loop=heater")).json()["readings"]
    assert readings[0]["output"] == 40.0


def test_the_error_is_that_of_the_start(loops, tmp_path):
    file = File(tmp_path, {"heater": {**loops["heater"], "driver": "none"}})
    with pytest.raises(ConfigurationError, match="is not an installed driver"):
        create_app(file.read(), InPlace())
