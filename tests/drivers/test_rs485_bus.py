"""Two units on one RS-485 line: two PLCs on libmodbus behind one pseudo-terminal.

Each hears all that is sent, the answers of the other too: libmodbus counts on that.
"""

import asyncio
import json
import os
import sys
import tty

import httpx
import pytest

from autotuner.errors import DriverError, LinkError
from autotuner_drivers.modbus.backend import create
from tests.control.processes import PATIENCE_S

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals exist on POSIX only"),
]
OUTPUTS = {7: 30.0, 8: 50.0}


class Bus:
    """What one end sends, all others hear."""

    def __init__(self, ports):
        self._lines = []
        master, self._slave = os.openpty()
        for line in (master, self._slave):
            tty.setraw(line)
        self.port = os.ttyname(self._slave)
        self._master = master
        for port in ports:
            line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            self._lines.append(line)
            asyncio.get_running_loop().add_reader(line, self._answer, line)
        asyncio.get_running_loop().add_reader(master, self._ask)

    def _ask(self):
        data = os.read(self._master, 256)
        for line in self._lines:
            os.write(line, data)

    def _answer(self, line):
        data = os.read(line, 256)
        for other in (self._master, *self._lines):
            if other != line:
                os.write(other, data)

    def close(self):
        for line in (self._master, *self._lines):
            asyncio.get_running_loop().remove_reader(line)
            os.close(line)
        os.close(self._slave)


@pytest.fixture
async def bus(peer, tmp_path):
    """Return the port of a bus with units 7 and 8."""
    ports = []
    for unit, output in OUTPUTS.items():
        ports.append(tmp_path / f"tty{unit}")
        peer("plc_libmodbus.py", "--rtu-link", ports[-1], "--unit", unit, "--baud", 9600, "--parity", "E",
             "--plant", 2, 10, 1.5, "--u0", output)  # fmt: skip
    line = Bus(ports)
    yield line.port
    line.close()


def backend(port, registers, unit, **options):
    line = {"transport": "rtu", "serial_port": port, "baudrate": 9600, "parity": "E", "unit": unit, "timeout_s": 0.3}
    return create(line | {"registers": registers, "max_gap": 8} | options)


async def test_two_loops_ask_in_turn(bus, default_map):
    loops = {unit: backend(bus, default_map, unit) for unit in OUTPUTS}
    for loop in loops.values():
        await loop.open()

    async def readings(unit):
        return [(await loops[unit].read(["output"]))["output"] for _ in range(40)]

    seen = await asyncio.gather(*map(readings, OUTPUTS))
    assert seen == [[output] * 40 for output in OUTPUTS.values()]
    await asyncio.gather(loops[7].write({"output": 41.0}), loops[8].write({"output": 52.0}))
    assert [(await loop.read(["output"]))["output"] for loop in loops.values()] == [41.0, 52.0]
    await loops[7].close()
    with pytest.raises(LinkError, match="not open"):
        await loops[7].read(["output"])
    assert (await loops[8].read(["output"]))["output"] == 52.0
    await loops[7].open()
    assert (await loops[7].read(["output"]))["output"] == 41.0
    for loop in loops.values():
        await loop.close()


async def test_a_unit_that_does_not_answer_costs_the_other_only_its_time_limit(bus, default_map):
    alive, dead = backend(bus, default_map, 8), backend(bus, default_map, 9, retries=0)
    await alive.open()
    await dead.open()
    for _ in range(5):
        outcomes = await asyncio.gather(dead.read(["output"]), alive.read(["output"]), return_exceptions=True)
        assert isinstance(outcomes[0], DriverError)
        assert outcomes[1] == {"output": 50.0}
    await dead.close()
    await alive.close()


async def test_all_loops_on_a_line_have_one_frame(bus, default_map):
    first = backend(bus, default_map, 7)
    await first.open()
    with pytest.raises(LinkError, match="open for another loop with other settings"):
        await backend(bus, default_map, 8, baudrate=19200).open()
    await first.close()
    second = backend(bus, default_map, 8, baudrate=19200)
    await second.open()  # nobody else has it open any more
    await second.close()


CONFIGURATION = """
[service]
data_directory = "{folder}/data"
port = 0

[loops.seven]
driver = "modbus"
sample_time_s = 0.25
relay = {{ amplitude = 10.0, quiet_s = 2.0, min_periods = 2, check = false }}
limits = {{ output = [0.0, 100.0], pv = [0.0, 250.0] }}
device = {{ {device}, unit = 7, registers = {registers} }}

[loops.eight]
driver = "modbus"
sample_time_s = 0.25
relay = {{ amplitude = 10.0, quiet_s = 2.0, min_periods = 2, check = false }}
limits = {{ output = [0.0, 100.0], pv = [0.0, 250.0] }}
device = {{ {device}, unit = 8, registers = {registers} }}
"""
REGISTERS = """{ pv = { table = "input", address = 0, type = "int16", scale = 0.1 }, \
output = { table = "holding", address = 0, type = "int16", scale = 0.1 }, auto = { table = "coil", address = 0 } }"""


@pytest.mark.long  # tests/drivers/test_shared_tunings.py tunes several loops of one line in virtual time
async def test_a_service_tunes_two_loops_of_one_line_at_once(bus, tmp_path):
    device = f'transport = "rtu", serial_port = "{bus}", baudrate = 9600, parity = "E", timeout_s = 0.3'
    config = tmp_path / "loops.toml"
    config.write_text(CONFIGURATION.format(folder=tmp_path, device=device, registers=REGISTERS))
    command = [sys.executable, "-m", "autotuner", "serve", "--json", "--config", str(config)]
    service = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    try:
        url = json.loads(await service.stdout.readline())["listening"]
        async with httpx.AsyncClient(base_url=url, timeout=PATIENCE_S) as client:
            started = [await client.post(f"/v1/loops/{name}/tunings") for name in ("seven", "eight")]
            assert [answer.status_code for answer in started] == [202, 202], [answer.text for answer in started]
            told = [await ended(client, answer.json()["id"]) for answer in started]
    finally:
        service.terminate()
        await service.wait()
    assert [one["verdict"]["outcome"] for one in told] == ["done", "done"], [one["verdict"] for one in told]
    assert [one["model"]["K"] for one in told] == pytest.approx([2.0, 2.0], rel=0.1)
    assert all(one["restored"] for one in told)


async def ended(client, tuning):
    async with asyncio.timeout(PATIENCE_S):
        while (told := (await client.get(f"/v1/tunings/{tuning}")).json())["state"] != "ended":  # noqa: ASYNC110 - a service only answers
            await asyncio.sleep(0.5)
    return told
