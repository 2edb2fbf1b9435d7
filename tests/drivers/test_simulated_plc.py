"""The simulated PLC on the wire: our client in virtual time; pyModbusTCP's client and a whole process on sockets."""

import argparse
import asyncio
import json
import math
import signal
import socket
import subprocess
import sys

import pytest
from pyModbusTCP.client import ModbusClient

from autotuner.errors import DeviceRefusedError
from autotuner_drivers.modbus.backend import create
from autotuner_sim.devices.loop_device import LoopDevice
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.plants import Fopdt
from autotuner_sim.plc_command import command
from autotuner_sim.stepped import SteppedPlant
from tests.control.processes import PATIENCE_S

RUN = """
import argparse, sys
from autotuner_sim.plc_command import command
parser = argparse.ArgumentParser()
command.configure(parser)
sys.exit(command.run(parser.parse_args()))
"""


def device(**options) -> LoopDevice:
    return LoopDevice(SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0), **options)


def backend(registers, **options):
    return create({"host": "plc", "port": 1502, "registers": registers} | options)


def test_ten_minutes_of_our_client_and_our_slave_in_virtual_time(virtual, default_map):
    async def main():
        seen = []
        async with serving_tcp(SimulatedPlc(device()), "plc", 1502):
            loop = backend(default_map)
            await loop.open()
            await loop.write({"output": 45.0})
            for _ in range(600):
                await asyncio.sleep(1.0)
                seen.append((await loop.read(["pv", "output", "scans", "auto"]))["pv"])
            await loop.close()
        return seen, asyncio.get_running_loop().time()

    seen, took_s = virtual(main())
    assert took_s == pytest.approx(600.0, abs=2.0)
    for k, pv in enumerate(seen[:60]):
        rise = 10.0 * (1.0 - math.exp(-max(k + 1.0 - 1.5, 0.0) / 10.0))
        # a tenth of resolution, and a scan of 0.05 s at a slope of at most 1 per s
        assert pv == pytest.approx(80.0 + rise, abs=0.05 + 0.055)
    assert seen[-1] == 90.0


def test_every_register_of_the_map_both_ways(virtual, default_map):
    async def main():
        async with serving_tcp(SimulatedPlc(device()), "plc", 1502):
            loop = backend(default_map, max_gap=8)
            await loop.open()
            before = await loop.read(loop.readable)
            written = {"auto": 1.0, "set_point": 81.5, "kp": 2.5, "ti": 12.0, "td": 0.25}
            await loop.write(written)
            after = await loop.read(written)
            await loop.write({"auto": 0.0, "output": 33.3})
            last = await loop.read(["output", "applied", "auto"])
            await loop.close()
        return before, written, after, last

    before, written, after, last = virtual(main())
    assert before["pv"] == 80.0
    assert (before["output"], before["applied"], before["auto"]) == (40.0, 40.0, 0.0)
    assert (before["kp"], before["ti"], before["td"]) == (1.0, 20.0, 0.0)
    assert after == pytest.approx(written)
    assert last == {"output": pytest.approx(33.3), "applied": pytest.approx(33.3), "auto": 0.0}


def test_the_counter_advances_with_the_scans(virtual, default_map):
    async def main():
        async with serving_tcp(SimulatedPlc(device(scan_s=0.1), speed=10.0), "plc", 1502):
            loop = backend(default_map)
            await loop.open()
            await asyncio.sleep(2.001)
            beats = (await loop.read(["scans"]))["scans"]
            await loop.close()
        return beats

    assert virtual(main()) == 200.0


def test_refusals_of_the_slave(virtual, default_map):
    async def main():
        async with serving_tcp(SimulatedPlc(device()), "plc", 1502):
            loop = backend(default_map | {"beyond": {"table": "holding", "address": 16}})
            await loop.open()
            with pytest.raises(DeviceRefusedError, match="illegal data address"):
                await loop.read(["beyond"])
            with pytest.raises(DeviceRefusedError, match="illegal data value"):
                await loop.write({"ti": -1.0})
            kept = await loop.read(["ti"])
            await loop.close()
        return kept

    assert virtual(main()) == {"ti": 20.0}


def test_two_clients_at_once(virtual, default_map):
    async def main():
        async with serving_tcp(SimulatedPlc(device()), "plc", 1502):
            one, two = backend(default_map), backend(default_map)
            await asyncio.gather(one.open(), two.open())
            await one.write({"output": 50.0})
            seen = await two.read(["output"])
            await one.close()
            seen |= await two.read(["auto"])
            await two.close()
        return seen

    assert virtual(main()) == {"output": 50.0, "auto": 0.0}


@pytest.fixture
def process():
    """Return a function that starts the command as a process and returns it with its ready line."""
    running = []

    def start(*arguments):
        started = subprocess.Popen(
            [sys.executable, "-c", RUN, "--port", "0", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        running.append(started)
        return started, json.loads(started.stdout.readline())

    yield start
    for started in running:
        started.kill()
        started.wait()
        started.stdout.close()
        started.stderr.close()


@pytest.mark.realtime
def test_pymodbustcp_as_the_client_of_the_command(process):
    _, ready = process("--noise", "0", "--set-point", "-12.3", "--gains", "1234.5", "20", "0")
    client = ModbusClient(host="127.0.0.1", port=ready["port"], unit_id=1, timeout=PATIENCE_S)
    assert client.read_input_registers(0, 2) == [800, 400]
    assert client.read_holding_registers(0, 2) == [400, 65536 - 123]
    assert client.read_holding_registers(10, 4) == [0x449A, 0x5000, 0x41A0, 0x0000]
    assert client.write_single_register(0, 415)
    assert client.read_input_registers(1, 1) == [415]
    assert client.write_multiple_registers(14, [0x3F80, 0x0000])
    assert client.read_holding_registers(14, 2) == [0x3F80, 0x0000]
    assert client.write_single_coil(0, True)
    assert client.read_coils(0, 1) == [True]
    assert client.read_discrete_inputs(0, 1) == [False]
    assert client.write_multiple_coils(0, [False])
    assert client.read_coils(0, 1) == [False]
    assert client.read_holding_registers(16, 1) is None
    assert client.last_except == 2
    assert not client.write_multiple_registers(12, [0x7FC0, 0x0000])
    assert client.last_except == 3
    client.close()


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_ends_cleanly_by_a_signal_also_with_a_client_connected(process, number):
    started, ready = process()
    assert ready["ready"] is True
    with socket.create_connection(("127.0.0.1", ready["port"])):
        started.send_signal(number)
        assert started.wait(PATIENCE_S) == 0
    assert started.stdout.read() == ""
    assert started.stderr.read() == ""


def run(*arguments):
    command = [sys.executable, "-c", RUN, *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=PATIENCE_S)


@pytest.mark.realtime
def test_a_port_in_use_is_told_with_the_way_out():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = run("--port", str(taken.getsockname()[1]))
    assert done.returncode == 1
    assert "Address already in use" in done.stderr
    assert "--port" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--plant", "K=2", "T=-1", "D=1"), "T must be positive"),
        (("--plant", "K=2", "T=10"), "K, T, D"),
        (("--plant", "K=two"), "NAME=VALUE"),
        (("--effect", "rust", "depth=1"), "Use one of backlash"),
        (("--speed", "0"), "--speed must be positive"),
        (("--output0", "500"), "output0"),
    ],
)
def test_wrong_arguments_end_with_2_and_a_reason(capsys, arguments, words):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    try:
        code = command.run(parser.parse_args(["--port", "0", *arguments]))
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert words in capsys.readouterr().err
