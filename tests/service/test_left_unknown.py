"""A loop that a tuning could not give back: what the next starts do about it, and what they tell, over Modbus."""

import asyncio
import contextlib
import shutil

import pytest

from autotuner.errors import LinkError
from autotuner_sim.devices.loop_device import LoopDevice
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

LOOP = {
    "driver": "modbus",
    "sample_time_s": 0.2,
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 200.0]},
    "relay": {"amplitude": 10.0, "check": False},
    "restore_limit_s": 5.0,
    "device": {
        "host": "plc",
        "port": 1502,
        "registers": {
            "pv": {"table": "input", "address": 0, "scale": 0.1},
            "output": {"table": "holding", "address": 0, "scale": 0.1},
            "auto": {"table": "coil", "address": 0},
        },
    },
}
LATER = "the loop could not be released at that end, later the output is restored to 40"


@pytest.fixture
def device():
    return LoopDevice(SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0), scan_s=0.05)


@pytest.fixture
def line_to():
    """Return a function that lets a device answer for as long as a context is open."""
    plcs = {}

    def answering(device):
        plc = plcs[id(device)] = plcs.get(id(device)) or SimulatedPlc(device)
        return serving_tcp(plc, "plc", 1502)

    return answering


async def moved(device):
    for _ in range(400):
        if abs(device.output - 40.0) > 1.0:
            return
        await asyncio.sleep(0.5)
    raise AssertionError("the relay never began")


async def snapshot_of(service, tuning_id):
    await asyncio.sleep(30.0)
    await service.app.state.archive.flush()
    return (await service.client.get(f"/v1/tunings/{tuning_id}")).json()


async def listed_by(service, tuning_id):
    rows = (await service.client.get("/v1/tunings")).json()["tunings"]
    return next((row["outcome"], row["code"]) for row in rows if row["id"] == tuning_id)


async def ended_in_the_dark(serving, configuration, device, line_to):
    """Have a tuning aborted after its line has died; return what is told of it then."""
    async with serving(configuration) as service:
        async with line_to(device):
            tuning = (await service.client.post("/v1/loops/TIC/tunings")).json()["id"]
            await moved(device)
        await service.client.post(f"/v1/tunings/{tuning}/abort")
        return await snapshot_of(service, tuning)


async def test_the_true_reason_is_told_with_what_became_of_the_loop(serving, configure, device, line_to, caplog):
    caplog.set_level("INFO")
    configuration = configure({"TIC": LOOP})
    dark = await ended_in_the_dark(serving, configuration, device, line_to)
    assert (dark["verdict"]["code"], dark["restored"]) == ("output_unknown", False)
    assert abs(device.output - 40.0) > 1.0
    for start in ("next", "later", "last"):
        caplog.clear()
        async with line_to(device), serving(configuration) as service:
            told = await snapshot_of(service, dark["id"])
            row = await listed_by(service, dark["id"])
            numbers = (await service.client.get("/metrics")).text
            audit = (await service.client.get("/v1/audit?actor=service")).json()["entries"]
        verdict, reason = told["verdict"], "was aborted"
        assert (verdict["outcome"], verdict["code"], told["restored"]) == ("aborted", "requested", True), start
        assert reason in verdict["message"]
        assert verdict["message"].endswith(
            "the loop could not be released at that end, later the output is restored to 40"
        )
        assert "killed" not in verdict["message"]
        assert row == ("aborted", "requested")
        assert told["samples"] == dark["samples"]
        assert device.output == 40.0
        assert "autotuner_tunings_total{" not in numbers
        assert 'autotuner_output_unknown{loop="TIC"} 0.0' in numbers
        deeds = [(deed["action"], deed["status"]) for deed in audit]
        assert deeds == [("tuning recovered at a later try", 200)]
        assert (f"tuning {dark['id']} of loop" in caplog.text) == (start == "next")


async def test_while_it_is_still_unknown_that_is_told_with_the_reason(serving, configure, device, line_to):
    configuration = configure({"TIC": LOOP})
    dark = await ended_in_the_dark(serving, configuration, device, line_to)
    async with serving(configuration) as service:
        told = await snapshot_of(service, dark["id"])
        numbers = (await service.client.get("/metrics")).text
    assert (told["verdict"]["code"], told["restored"]) == ("output_unknown", False)
    assert "was aborted" in told["verdict"]["message"]
    assert "killed" not in told["verdict"]["message"]
    assert 'autotuner_output_unknown{loop="TIC"} 1.0' in numbers


@pytest.mark.long  # what is told of an unknown output is in the others
async def test_a_result_that_was_had_stays_one(serving, configure, device, line_to):
    """The line dies between the last sample and the way back: model and gains are there, the output was not."""
    configuration = configure({"TIC": LOOP})
    async with serving(configuration) as service, line_to(device):
        backend = service.manager._backends["TIC"]
        asked = {"structure": "fopdt", "rule": "simc_pi"}
        tuning = (await service.client.post("/v1/loops/TIC/tunings", json=asked)).json()["id"]
        writing = backend.write

        async def write(values):
            if service.manager.tuning(tuning).controller.experiment.phase == "restore":
                raise LinkError("the line is dead", remedy="Plug it in.")
            await writing(values)

        backend.write = write
        await service.client.get(f"/v1/tunings/{tuning}/events")
        dark = await snapshot_of(service, tuning)
    assert dark["verdict"]["code"] == "output_unknown"
    assert dark["model"]["K"] == pytest.approx(2.0, rel=0.05)
    async with line_to(device), serving(configuration) as service:
        told = await snapshot_of(service, tuning)
    assert (told["verdict"]["outcome"], told["verdict"]["code"]) == ("done", "identified")
    assert told["verdict"]["message"].endswith(LATER)
    assert (told["model"], told["gains"], told["restored"]) == (dark["model"], dark["gains"], True)
    assert device.output == 40.0


async def test_an_interrupted_tuning_is_told_once(serving, configure, device, line_to, caplog, tmp_path):
    """Data directory as a killed service leaves it; the database has what the first start told of it."""
    caplog.set_level("INFO")
    configuration = configure({"TIC": LOOP}, data_directory=str(tmp_path / "left"))
    async with line_to(device):
        async with serving(configure({"TIC": LOOP})) as service:
            tuning = (await service.client.post("/v1/loops/TIC/tunings")).json()["id"]
            await moved(device)
            await service.app.state.archive.flush()
            shutil.copytree(tmp_path / "data", tmp_path / "left")
            left = device.output
        device.command(left)
        for start in ("next", "later"):
            caplog.clear()
            async with serving(configuration) as service:
                told = await snapshot_of(service, tuning)
                numbers = (await service.client.get("/metrics")).text
            assert (told["verdict"]["code"], told["restored"]) == ("interrupted", True)
            assert device.output == 40.0
            assert (f"tuning {tuning} of loop" in caplog.text) == (start == "next")
            assert ('code="interrupted"' in numbers) == (start == "next")


async def test_what_could_not_be_given_back_at_first_is_told_as_it_ends(serving, configure, device, line_to, tmp_path):
    """The first start after a kill finds the line dead, and the database says so until another gives the loop back."""
    configuration = configure({"TIC": LOOP}, data_directory=str(tmp_path / "left"))
    async with serving(configure({"TIC": LOOP})) as service, line_to(device):
        tuning = (await service.client.post("/v1/loops/TIC/tunings")).json()["id"]
        await moved(device)
        await service.app.state.archive.flush()
        shutil.copytree(tmp_path / "data", tmp_path / "left")
        left = device.output
    device.command(left)
    seen = []
    for line in (contextlib.nullcontext(), line_to(device), line_to(device)):
        async with line, serving(configuration) as service:
            told = (await snapshot_of(service, tuning))["verdict"]["code"]
            seen.append((told, (await listed_by(service, tuning))[1]))
    unknown, interrupted = ("output_unknown",) * 2, ("interrupted",) * 2
    assert seen == [unknown, interrupted, interrupted]
