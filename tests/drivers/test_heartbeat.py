"""The heartbeat: the PLC's own watchdog takes over when the loop is driven no more, and only then."""

import asyncio

import pytest

from autotuner_drivers.modbus.backend import create
from autotuner_sim.devices.loop_device import LoopDevice, Watchdog
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

BEAT = {"heartbeat": {"table": "holding", "address": 2, "type": "uint16"}}


def plc() -> SimulatedPlc:
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0)
    return SimulatedPlc(LoopDevice(plant, watchdog=Watchdog(3.0, 5.0)))


async def driven(registers, *, beats: bool):
    """Take the output to 60 and read on for a minute; then go silent for a minute, as a crashed program does."""
    served = plc()
    async with serving_tcp(served, "plc", 1502):
        loop = create({"host": "plc", "port": 1502, "registers": registers | (BEAT if beats else {})})
        await loop.open()
        await loop.write({"output": 60.0})
        for _ in range(60):
            await asyncio.sleep(1.0)
            await loop.read(["pv"])
        while_driven = served.device.output
        await asyncio.sleep(60.0)
        after_silence = served.device.output
        await loop.close()
        await asyncio.sleep(60.0)
    return while_driven, after_silence, served.device.beat


def test_the_plc_takes_over_when_the_beats_stop(virtual, default_map):
    assert virtual(driven(default_map, beats=True)) == (60.0, 5.0, 0)


def test_without_a_heartbeat_the_output_stays(virtual, default_map):
    assert virtual(driven(default_map, beats=False)) == (60.0, 60.0, 0)


def test_closing_in_order_calls_the_watchdog_off(virtual, default_map):
    async def main():
        served = plc()
        async with serving_tcp(served, "plc", 1502):
            loop = create({"host": "plc", "port": 1502, "registers": default_map | BEAT})
            await loop.open()
            await loop.write({"output": 60.0})
            await loop.read(["pv"])
            beating = served.device.beat
            await loop.close()
            await asyncio.sleep(60.0)
        return beating, served.device.output, served.device.alarm

    assert virtual(main()) == (1, 60.0, False)


def test_it_counts_on_and_skips_0_when_it_wraps(virtual, default_map):
    async def main():
        served, seen = plc(), []
        async with serving_tcp(served, "plc", 1502):
            loop = create({"host": "plc", "port": 1502, "registers": default_map | BEAT})
            await loop.open()
            loop._beats = 65533
            for _ in range(4):
                await loop.read([])
                seen.append(served.device.beat)
            await loop.close()
        return seen

    assert virtual(main()) == [65534, 65535, 1, 2]


@pytest.mark.realtime
async def test_libmodbus_sees_a_sign_of_life_in_a_heartbeat(peer, default_map):
    """Its watchdog trips after a second without any write in manual."""
    ready = peer(
        "plc_libmodbus.py", "--tcp", 0, "--plant", 2, 10, 1.5, "--u0", 40, "--watchdog", 1.0, 5.0, "--registers",
        "pv=ir:0:int16:0.1,out=hr:0:int16:0.1,cwd=hr:2:uint16,alarm=di:0",
    )  # fmt: skip
    registers = {
        "pv": default_map["pv"],
        "output": default_map["output"],
        "alarm": {"table": "discrete", "address": 0},
    }
    loop = create({"host": "127.0.0.1", "port": ready["tcp"], "registers": registers | BEAT})
    await loop.open()
    for _ in range(20):
        await asyncio.sleep(0.1)
        seen = await loop.read(["output", "alarm"])
    await loop.close()
    assert seen == {"output": 40.0, "alarm": 0.0}
    await asyncio.sleep(1.5)
    silent = create({"host": "127.0.0.1", "port": ready["tcp"], "registers": registers})
    await silent.open()
    assert await silent.read(["output", "alarm"]) == {"output": 5.0, "alarm": 1.0}
    await silent.close()
