"""Gains into a PLC over Modbus and back, in virtual time: the registers, word by word, and what the loop then does."""

import asyncio
import shutil
import struct

import numpy as np
import pytest

from autotuner_sim.devices.loop_device import Gains, LoopDevice
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.devices.plc_registers import holding_words
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

OLD = Gains(0.7, 13.3, 0.1)
FLOATS = {name: {"table": "holding", "address": at, "type": "float32"} for name, at in
          (("kp", 10), ("ti", 12), ("td", 14))}  # fmt: skip
LOOP = {
    "driver": "modbus",
    "sample_time_s": 0.2,
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 200.0]},
    "relay": {"amplitude": 10.0, "check": False},
    "gains": {"form": "siemens_pid_compact", "output_span": 100.0, "derivative_filter": 8.0, "scan_s": 0.05},
    "device": {
        "host": "plc",
        "port": 1502,
        "registers": {
            "pv": {"table": "input", "address": 0, "scale": 0.1},
            "output": {"table": "holding", "address": 0, "scale": 0.1},
            "set_point": {"table": "holding", "address": 1, "scale": 0.1},
            "auto": {"table": "coil", "address": 0},
            **FLOATS,
        },
    },
}


def a_plc(*, auto):
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Noise(0.05, seed=3)])
    return LoopDevice(plant, scan_s=0.05, gains=OLD, auto=auto)


async def tuned(client, **body):
    started = (await client.post("/v1/loops/TIC/tunings", json={"structure": "fopdt"} | body)).json()
    await client.get(started["links"]["events"])
    return (await client.get(started["links"]["self"])).json()


async def followed(plc, device, step, seconds):
    """Let the device settle, then follow a set-point step; return its true overshoot, share of the step."""
    await asyncio.sleep(60.0)
    plc.advance()
    rest, device.set_point = device.set_point, device.set_point + step
    pvs = []
    for _ in range(int(seconds / 0.2)):
        await asyncio.sleep(0.2)
        plc.advance()
        pvs.append(device._plant.pv)
    return (max(pvs) - rest) / step - 1.0


async def test_applied_the_loop_follows_as_predicted_and_rollback_restores_every_word(serving, configure):
    device = a_plc(auto=True)
    plc = SimulatedPlc(device)
    async with serving_tcp(plc, "plc", 1502), serving(configure({"TIC": LOOP})) as service:
        before = holding_words(device)[10:16]
        tuning = await tuned(service.client)
        assert tuning["verdict"]["outcome"] == "done", tuning["verdict"]
        assert tuning["device_gains"]["kp"] == struct.unpack(">f", struct.pack(">f", OLD.kp))[0]
        applied = (await service.client.post(tuning["links"]["apply"])).json()
        wanted = np.float32([tuning["gains"][name] for name in ("Kp", "Ti", "Td")])
        assert holding_words(device)[10:16] == list(np.frombuffer(wanted.astype(">f4").tobytes(), ">u2"))
        assert applied["labels"] == pytest.approx(dict(zip(("Gain", "Ti", "Td"), wanted.tolist(), strict=True)))
        verified = (await service.client.post(tuning["links"]["verify"])).json()
        assert verified["passed"], verified["verdict"]
        seen = await followed(plc, device, 5.0, 60.0)
        assert seen == pytest.approx(verified["predicted_overshoot"], abs=0.05)
        device.set_point = 80.0
        back = await service.client.post(tuning["links"]["rollback"])
        assert back.status_code == 200, back.text
        assert holding_words(device)[10:16] == before
        assert device.auto


@pytest.mark.long  # tests/design/test_verification has the valve, the tests beside it what goes back
async def test_a_valve_that_began_to_stick_is_found_and_everything_goes_back(serving, configure):
    from autotuner_sim.effects import Backlash

    device = a_plc(auto=False)
    plc = SimulatedPlc(device)
    async with serving_tcp(plc, "plc", 1502), serving(configure({"TIC": LOOP})) as service:
        before = holding_words(device)
        tuning = await tuned(service.client)
        await service.client.post(tuning["links"]["apply"])
        plc.advance()
        worn = SteppedPlant(Fopdt(4.0, 10.0, 1.5), output0=40.0, pv0=80.0, actuators=[Backlash(1.0)],
                            sensors=[Noise(0.05, seed=4)])  # fmt: skip
        worn.advance(device._plant.t)
        device._plant = worn
        verified = (await service.client.post(tuning["links"]["verify"])).json()
        assert (verified["passed"], verified["rolled_back"]) == (False, True), verified["verdict"]
        after = holding_words(device)
        assert after[10:16] == before[10:16]
        assert after[:2] == before[:2]
        assert not device.auto


async def test_the_old_gains_outlive_the_program(serving, configure):
    device = a_plc(auto=True)
    async with serving_tcp(SimulatedPlc(device), "plc", 1502):
        async with serving(configure({"TIC": LOOP})) as service:
            tuning = await tuned(service.client, apply=True)
            await service.client.get(tuning["links"]["self"])
        assert device.gains != OLD
        async with serving(configure({"TIC": LOOP})) as service:
            told = (await service.client.get("/v1/loops/TIC/gains")).json()
            assert told["undo"]["tuning_id"] == tuning["id"]
            back = await service.manager.gain_service("TIC").roll_back()
            assert back.now["kp"] == pytest.approx(OLD.kp, rel=1e-7)
        assert (device.gains.kp, device.gains.ti) == pytest.approx((OLD.kp, OLD.ti), rel=1e-7)


async def test_a_verification_that_was_killed_is_told_where_it_is_looked_for(serving, configure, tmp_path):
    """Data directory and device as they stand in the middle of the step: what a killed service leaves behind."""
    device = a_plc(auto=False)
    async with serving_tcp(SimulatedPlc(device), "plc", 1502):
        before = holding_words(device)
        async with serving(configure({"TIC": LOOP})) as service:
            tuning = await tuned(service.client)
            await service.client.post(tuning["links"]["apply"])
            verifying = asyncio.create_task(service.client.post(tuning["links"]["verify"]))
            for _ in range(400):
                await asyncio.sleep(0.5 if abs(device.set_point - 80.0) < 1.0 else 0.0)
            assert abs(device.set_point - 80.0) > 1.0
            await service.app.state.archive.flush()
            shutil.copytree(tmp_path / "data", tmp_path / "left")
            left = device.gains, device.set_point, device.auto
            await service.client.post(tuning["links"]["abort"])
            await verifying
        device.gains, device.set_point, device.auto = left
        assert holding_words(device)[10:16] != before[10:16]
        for start in ("next", "later"):
            async with serving(configure({"TIC": LOOP}, data_directory=str(tmp_path / "left"))) as service:
                await asyncio.sleep(30.0)
                await service.app.state.archive.flush()
                told = (await service.client.get(tuning["links"]["self"])).json()
                audit = (await service.client.get("/v1/audit?actor=service")).json()["entries"]
                numbers = (await service.client.get("/metrics")).text
                changes = await service.app.state.archive.gains(tuning["id"])
            verification = told["verification"]
            assert (verification["state"], verification["rolled_back"]) == ("ended", True), start
            assert verification["verdict"]["code"] == "interrupted"
            assert told["applied"] is None
            assert (told["model"], told["verdict"]) == (tuning["model"], tuning["verdict"])
            deeds = [(deed["action"], deed["status"], deed["loop"], deed["tuning_id"]) for deed in audit]
            assert deeds == [("verification recovered after a kill", 200, "TIC", tuning["id"])]
            counted = 'autotuner_verifications_total{code="interrupted",loop="TIC",outcome="aborted"} 1.0' in numbers
            assert counted is (start == "next")
            assert 'code="identified"' not in numbers
            assert [change["action"] for change in changes] == ["applied", "rolled back"]
        after = holding_words(device)
        assert (after[10:16], after[:2]) == (before[10:16], before[:2])
        assert not device.auto
