"""What the page shows beside tunings: readings of idle loops, plans, curves and choices."""

import asyncio

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.control.devices.device_polling import Visits
from autotuner.errors import LinkError
from autotuner.ports import OUTPUT, PV
from autotuner.service.page import FILES


@pytest.mark.virtual_time
async def test_an_idle_loop_is_looked_at_when_somebody_asks(serving):
    async with serving() as service:
        first = (await service.client.get("/v1/readings?loop=heater")).json()["readings"]
        await asyncio.sleep(0.1)
        second = (await service.client.get("/v1/readings?loop=heater")).json()["readings"]
    assert (first[0]["at"], first[0]["pv"]) == (None, None)
    assert second[0]["output"] == 40.0
    assert second[0]["pv"] == pytest.approx(80.0, abs=0.5)


@pytest.mark.virtual_time
async def test_the_reading_of_a_loop_being_tuned_is_its_last_sample(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        await asyncio.sleep(10.0)
        reading = (await service.client.get("/v1/readings?loop=heater")).json()["readings"][0]
        assert reading["tuning_id"] == "tuning-1"
        assert reading["pv"] == service.manager.tuning("tuning-1").samples[-1].pv


@pytest.mark.virtual_time
async def test_gains_are_not_read_under_a_running_tuning(serving, check_problem):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        await asyncio.sleep(5.0)
        answer = await service.client.get("/v1/loops/heater/gains")
        assert check_problem(answer, 409, "loop-busy")["tuning_id"] == "tuning-1"


class Device:
    """A device that takes its time; counts who is connected."""

    readable, writable = frozenset({PV, OUTPUT}), frozenset({OUTPUT})

    def __init__(self, takes_s=0.0, fails=False):
        self.takes_s, self.fails, self.reads, self.connected = takes_s, fails, 0, False

    async def open(self):
        self.connected = True

    async def read(self, names):
        self.reads += 1
        await asyncio.sleep(self.takes_s)
        if self.fails:
            raise LinkError("no answer", remedy="Check the cable.")
        return dict.fromkeys(names, 1.0)

    async def write(self, values):
        raise AssertionError(values)

    async def close(self):
        self.connected = False


@pytest.mark.virtual_time
async def test_a_look_ends_and_disconnects_before_something_more_important_begins():
    device = Device(takes_s=3.0)
    visits = Visits(device, 0.1)
    visits.look()
    await asyncio.sleep(1.0)
    assert device.connected
    began = asyncio.get_running_loop().time()
    await visits.clear()
    assert asyncio.get_running_loop().time() == began
    assert (device.connected, visits.reading.at) == (False, None)


@pytest.mark.virtual_time
async def test_looks_are_never_more_frequent_than_once_a_second():
    device = Device()
    visits = Visits(device, 0.01)
    for _ in range(100):
        visits.look()
        await asyncio.sleep(0.05)
    assert device.reads == 5
    assert not device.connected


@pytest.mark.virtual_time
async def test_a_dead_link_is_told_with_what_to_do():
    visits = Visits(Device(fails=True), 1.0)
    visits.look()
    await asyncio.sleep(0.1)
    assert visits.reading.error == "no answer. Check the cable."


@pytest.mark.virtual_time
async def test_a_device_that_connecting_resets_is_left_alone():
    device = Device()
    device.opening_disturbs = True
    visits = Visits(device, 1.0)
    visits.look()
    await asyncio.sleep(1.0)
    assert device.reads == 0
    assert "not polled" in visits.reading.error


@pytest.mark.virtual_time
async def test_a_plan_tells_the_levels_of_the_relay(serving):
    async with serving() as service:
        blind = (await service.client.post("/v1/loops/heater/plan")).json()
        seen = (await service.client.post("/v1/loops/heater/plan?output=40", json={"ratio": 1.0})).json()
        edge = (await service.client.post("/v1/loops/heater/plan?output=100")).json()
    assert (blind["levels"], blind["amplitude"]) == (None, 10.0)
    assert (seen["levels"]["low"], seen["levels"]["high"]) == (30.0, 50.0)
    assert edge["levels"] == {"low": 80.0, "high": 100.0, "one_sided": True}
    assert [step["phase"] for step in seen["steps"]] == ["quiet", "relay", "check", "restore"]
    assert "between 30 and 50 %" in seen["steps"][1]["text"]


@pytest.mark.virtual_time
async def test_curves_and_choices_of_a_tuning(serving, undescribed, check_problem):
    from autotuner.service.schemas import views
    from autotuner.service.schemas.diagnosis import DiagnosisCurves

    async with serving(pool=InPlace()) as service:
        await service.client.post("/v1/loops/heater/tunings")
        check_problem(await service.client.get("/v1/tunings/tuning-1/curves"), 409, "wrong-state")
        check_problem(await service.client.get("/v1/tunings/tuning-1/choices"), 409, "wrong-state")
        check_problem(await service.client.get("/v1/tunings/tuning-1/before-after"), 409, "wrong-state")
        await service.client.get("/v1/tunings/tuning-1/events")
        curves = (await service.client.get("/v1/tunings/tuning-1/curves?most=200")).json()
        choices = (await service.client.get("/v1/tunings/tuning-1/choices")).json()
        told = (await service.client.get("/v1/tunings/tuning-1")).json()
        both = (await service.client.get("/v1/tunings/tuning-1/before-after?most=200")).json()
    assert undescribed(DiagnosisCurves.model_validate(both)) == {}
    assert 100 <= len(both["t_s"]) <= 200
    assert max(map(abs, both["residual_after"])) < 0.5
    assert undescribed(views.Curves.model_validate(curves)) == {}
    assert undescribed(views.Choices.model_validate(choices)) == {}
    assert 100 <= len(curves["t_s"]) <= 200
    assert max(map(abs, curves["residual"])) < 0.5
    assert [choice["name"] for choice in choices["choices"]] == ["calm", "balanced", "brisk"]
    for choice in choices["choices"]:
        step = choice["responses"]["set_point_step"]
        assert step <= max(curves["pv"]) - min(curves["pv"])
        assert choice["responses"]["step_pv"][-1] == pytest.approx(step, abs=0.05 * step)
        assert choice["responses"]["load_pv"][-1] == pytest.approx(0.0, abs=0.05 * step)
    offered = next(choice for choice in choices["choices"] if choice["name"] == "balanced")
    assert offered["gains"] == told["tuning"]["gains"]  # what is offered is what would be written
    assert offered["asked"] == {"goal": "balanced"}


@pytest.mark.long  # the choices of a tuning, above
@pytest.mark.virtual_time
async def test_what_was_asked_for_is_among_the_choices_and_can_be_applied_again(serving):
    asked = {"Ms": 1.5, "controller": "PI", "jitter": 0.5}
    async with serving(pool=InPlace()) as service:
        await service.client.post("/v1/loops/heater/tunings", json={**asked, "check": False})
        await service.client.get("/v1/tunings/tuning-1/events")
        told = (await service.client.get("/v1/tunings/tuning-1")).json()["tuning"]
        choices = (await service.client.get("/v1/tunings/tuning-1/choices")).json()["choices"]
        again = (await service.client.post("/v1/tunings/tuning-1/gains", json=choices[-1]["asked"])).json()
    assert choices[-1]["name"] == told["goal"] == "Ms 1.5, PI, jitter 0.5"
    assert choices[-1]["asked"] == {"goal": "balanced", **asked}
    assert told["gains"]["Td"] == 0.0
    assert told["jitter"] <= 0.5 * 1.01
    assert again == told


@pytest.mark.virtual_time
@pytest.mark.parametrize("name", sorted(FILES))
async def test_the_files_of_the_page_are_served(serving, name):
    async with serving() as service:
        answer = await service.client.get(f"/page/{name}")
        again = await service.client.get(f"/page/{name}", headers={"If-None-Match": answer.headers["etag"]})
    assert (answer.status_code, again.status_code) == (200, 304)
    assert "http://" not in answer.text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in answer.text


@pytest.mark.virtual_time
@pytest.mark.parametrize("name", ["nothing.js", "../__init__.py", "%2e%2e/__init__.py", ""])
async def test_nothing_else_is_served(serving, check_problem, name):
    async with serving() as service:
        assert (await service.client.get(f"/page/{name}")).status_code == 404
