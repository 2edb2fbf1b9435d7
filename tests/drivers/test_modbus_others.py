"""The Modbus driver on real sockets against servers of other people: pyModbusTCP and libmodbus."""

import asyncio
import contextlib
import json
import math
import os
import signal
import struct
import threading

import pytest
from pyModbusTCP.server import DataBank, ModbusServer

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner_drivers.modbus.backend import create
from tests.control.processes import PATIENCE_S

pytestmark = pytest.mark.realtime

LITTLE = {
    "pv": {"table": "input", "address": 100, "type": "float32"},
    "output": {"table": "holding", "address": 200, "type": "float32"},
    "auto": {"table": "coil", "address": 3},
}


async def outcome(loop, wanted):
    """Read the PV again and again until the value, or the error, is as wanted; return it."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                seen = (await loop.read(["pv"]))["pv"]
            except DriverError as error:
                seen = error
            if wanted(seen):
                return seen
            await asyncio.sleep(0.02)


@pytest.fixture
def serve():
    """Return a function that serves a bank of registers by pyModbusTCP; its threads and sockets end with the test."""
    before, servers = set(threading.enumerate()), []

    def start(data, port=0):
        server = ModbusServer("127.0.0.1", port, no_block=True, data_bank=data)
        server.start()
        servers.append(server)
        return server, server._service.server_address[1]

    yield start
    for server in servers:
        server.stop()
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)


@pytest.fixture
def bank(serve):
    """The registers of a pyModbusTCP server with 1,000 addresses, and its port."""
    data = DataBank(coils_size=1000, d_inputs_size=1000, h_regs_size=1000, i_regs_size=1000)
    return data, serve(data)[1]


async def test_pymodbustcp_sees_what_we_write_and_we_read_what_it_holds(bank, default_map):
    data, port = bank
    data.set_input_registers(0, [215, 65535, 7])
    data.set_coils(0, [True])
    loop = create({"host": "127.0.0.1", "port": port, "registers": default_map})
    await loop.open()
    assert await loop.read(["pv", "applied", "scans", "auto"]) == {
        "pv": 21.5,
        "applied": pytest.approx(-0.1),
        "scans": 7.0,
        "auto": 1.0,
    }
    await loop.write({"auto": 0.0, "output": -12.3, "kp": 1234.5})
    await loop.close()
    assert data.get_coils(0, 1) == [False]
    assert data.get_holding_registers(0, 1) == [65536 - 123]
    assert data.get_holding_registers(10, 2) == [0x449A, 0x5000]


async def test_orders_and_function_codes_as_pymodbustcp_understands_them(bank):
    data, port = bank
    low, high = struct.unpack("<HH", struct.pack("<f", 1234.5))
    data.set_input_registers(100, [low, high])
    loop = create(
        {
            "host": "127.0.0.1",
            "port": port,
            "word_order": "little",
            "use_fc5": False,
            "use_fc6": False,
            "registers": LITTLE,
        }
    )
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 1234.5
    await loop.write({"output": 1234.5, "auto": 1.0})
    await loop.close()
    assert data.get_holding_registers(200, 2) == [low, high]
    assert data.get_coils(3, 1) == [True]


async def test_an_address_that_the_device_lacks(bank, default_map):
    _, port = bank
    loop = create(
        {"host": "127.0.0.1", "port": port, "registers": default_map | {"far": {"table": "input", "address": 5000}}}
    )
    await loop.open()
    with pytest.raises(DeviceRefusedError, match="illegal data address"):
        await loop.read(["pv", "far"])
    assert (await loop.read(["pv"]))["pv"] == 0.0
    await loop.close()


async def test_a_server_that_goes_away_and_comes_back(serve, default_map):
    data = DataBank()
    server, port = serve(data)
    loop = create({"host": "127.0.0.1", "port": port, "timeout_s": 0.5, "registers": default_map})
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 0.0
    server.stop()
    assert isinstance(await outcome(loop, lambda seen: isinstance(seen, DriverError)), LinkError)
    serve(data, port)
    data.set_input_registers(0, [300])
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 30.0
    await loop.close()


async def test_a_closed_port_is_a_link_error(default_map):
    loop = create({"host": "127.0.0.1", "port": 1, "registers": default_map})
    with pytest.raises(LinkError, match=r"127\.0\.0\.1:1 unit 1 refused"):
        await loop.open()


async def test_a_host_that_does_not_exist_is_a_link_error(default_map):
    loop = create({"host": "no-such-host.invalid", "registers": default_map, "timeout_s": 5.0})
    with pytest.raises(LinkError, match=r"no-such-host\.invalid:502"):
        await loop.open()


class Truth:
    """The control port of the libmodbus peer."""

    def __init__(self, reader, writer, pid):
        self.reader, self.writer, self.pid = reader, writer, pid

    async def ask(self, line: str) -> dict:
        self.writer.write(line.encode() + b"\n")
        return json.loads(await self.reader.readline())


@pytest.fixture
async def plc(peer):
    """Return a function that starts the libmodbus PLC: its port and its truth."""
    writers = []

    async def start(*arguments):
        ready = peer("plc_libmodbus.py", "--tcp", 0, "--control", 0, "--plant", 2, 10, 1.5, *arguments)
        reader, writer = await asyncio.open_connection("127.0.0.1", ready["control"])
        writers.append(writer)
        return ready["tcp"], Truth(reader, writer, ready["pid"])

    yield start
    for writer in writers:
        writer.close()
        await writer.wait_closed()


async def test_libmodbus_default_map(plc, default_map):
    port, truth = await plc("--u0", 30, "--scan", 0.01)
    loop = create({"host": "127.0.0.1", "port": port, "registers": default_map})
    await loop.open()
    first = await loop.read(loop.readable)
    assert first["output"] == 30.0
    assert first["auto"] == 0.0
    assert first["pv"] == pytest.approx((await truth.ask("get"))["y_true"], abs=0.06)
    await loop.write({"kp": 3.25, "ti": 40.0, "td": 2.5, "output": 41.7})
    state = await truth.ask("get")
    assert (state["u_cmd"], state["kp"], state["ti"], state["td"]) == (pytest.approx(41.7), 3.25, 40.0, 2.5)
    await loop.write({"auto": 1.0})
    assert (await truth.ask("get"))["auto"] == 1.0
    await loop.close()


SHAPES = {
    "float32, low word first": (
        ("--registers", "pv=ir:100:float32,out=hr:200:float32,auto=co:0", "--word-order", "little"),
        {
            "word_order": "little",
            "registers": LITTLE | {"auto": {"table": "coil", "address": 0}},
        },
    ),
    "int16, function codes 6 and 23 denied": (("--deny-fc", "6,23"), {"use_fc6": False}),
    "one client only": (("--max-clients", 1), {}),
    "at most 10 registers a read": (
        ("--max-read", 10, "--table-size", 40),
        {"max_registers_per_read": 10, "max_gap": 20},
    ),
    "little bytes, int32 and float64": (
        ("--registers", "pv=ir:2:int32:0.001:-40,out=hr:4:float64,auto=co:0", "--byte-order", "little"),
        {
            "byte_order": "little",
            "registers": {
                "pv": {"table": "input", "address": 2, "type": "int32", "scale": 0.001, "offset": -40.0},
                "output": {"table": "holding", "address": 4, "type": "float64"},
                "auto": {"table": "coil", "address": 0},
            },
        },
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
async def test_libmodbus_in_the_shapes_of_real_plcs(plc, default_map, shape):
    arguments, options = SHAPES[shape]
    port, truth = await plc("--u0", 20, *arguments)
    loop = create({"host": "127.0.0.1", "port": port, "registers": default_map} | options)
    await loop.open()
    before = await loop.read(loop.readable)
    assert before["output"] == pytest.approx(20.0)
    assert before["pv"] == pytest.approx((await truth.ask("get"))["y_true"], abs=0.06)
    await loop.write({"output": 33.3})
    assert (await truth.ask("get"))["u_cmd"] == pytest.approx(33.3)
    await loop.close()


async def test_libmodbus_broken_sensor(plc, default_map):
    port, truth = await plc("--scan", 0.01)
    pv = default_map["pv"] | {"invalid": [32767]}
    loop = create({"host": "127.0.0.1", "port": port, "registers": default_map | {"pv": pv}})
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 20.0
    await truth.ask("fault nan 60")
    assert math.isnan(await outcome(loop, lambda seen: seen != 20.0))
    await loop.close()


@pytest.mark.parametrize("fault", ["silent", "drop", "refuse", "wrongtid", "partial", "garbage", "exception=4"])
async def test_libmodbus_faults_end_in_typed_errors_and_pass(plc, default_map, fault):
    port, truth = await plc()
    loop = create({"host": "127.0.0.1", "port": port, "timeout_s": 0.2, "retries": 0, "registers": default_map})
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 20.0
    await truth.ask(f"fault {fault} 60")
    kind = DeviceRefusedError if fault.startswith("exception") else LinkError
    assert isinstance(await outcome(loop, lambda seen: isinstance(seen, DriverError)), kind)
    await truth.ask("clear")
    assert await outcome(loop, lambda seen: not isinstance(seen, DriverError)) == 20.0
    assert await loop.read(["pv", "output"]) == {"pv": 20.0, "output": 0.0}
    await loop.close()


class Gaps(DataBank):
    """A bank that refuses reads which touch a register of `holes`, or are longer than `longest`."""

    holes = frozenset({2, 3, 8})
    longest = 10
    refused = 0

    def get_holding_registers(self, address, number=1, srv_info=None):
        """Return the words, or None, which the server answers by exception 2."""
        if srv_info is not None and (number > self.longest or self.holes & set(range(address, address + number))):
            self.refused += 1
            return None
        return super().get_holding_registers(address, number, srv_info)


def pair_at(port, first, second, table="holding", **options):
    """Return a loop that reads its PV at one address of a table and its output at a holding register."""
    registers = {"pv": {"table": table, "address": first}, "output": {"table": "holding", "address": second}}
    return create({"host": "127.0.0.1", "port": port, "registers": registers, "timeout_s": 0.5} | options)


async def test_pymodbustcp_refuses_gaps_to_loops_that_share_it(serve):
    """Each loop has its values in every reading; what was refused together is asked for alone from then on."""
    data = Gaps()
    data.set_holding_registers(0, list(range(100, 130)))
    _, port = serve(data)
    loops = [pair_at(port, a, b, max_gap=4) for a, b in ((0, 1), (4, 5), (6, 7), (9, 10), (20, 21), (2, 4))]
    for loop in loops:
        await loop.open()
    readings = []
    for _ in range(4):
        reads = (loop.read(["pv", "output"]) for loop in loops)
        readings.append(await asyncio.gather(*reads, return_exceptions=True))
        refused = data.refused
    for seen in readings:
        assert isinstance(seen[-1], DeviceRefusedError)
        assert seen[:-1] == [{"pv": 100.0 + a, "output": 101.0 + a} for a in (0, 4, 6, 9, 20)]
    for _ in range(3):
        reads = (loop.read(["pv", "output"]) for loop in loops[:-1])
        assert await asyncio.gather(*reads) == readings[0][:-1]
    assert data.refused == refused + 1  # without the last loop others are neighbours, across a hole
    for loop in loops:
        await loop.close()


async def test_loops_of_a_libmodbus_plc_that_serves_one_client(plc):
    """Loops that share its connection read and write; one that has its own finds no place."""
    port, truth = await plc("--u0", 20, "--scan", 0.01, "--max-clients", 1)
    loops = [pair_at(port, address, output, "input") for address, output in ((0, 0), (1, 1), (2, 10))]
    for loop in loops:
        await loop.open()
    await asyncio.gather(loops[0].write({"output": 333.0}), loops[1].write({"output": 555.0}))
    for _ in range(50):
        seen = await asyncio.gather(*(loop.read(["pv", "output"]) for loop in loops))
    state = await truth.ask("get")
    assert state["u_cmd"] == pytest.approx(33.3)
    assert [one["output"] for one in seen[:2]] == [333.0, 555.0]
    assert seen[0]["pv"] == pytest.approx(10.0 * state["y_true"], abs=5.0)
    assert seen[2]["pv"] > 0.0
    stranger = pair_at(port, 0, 0, "input", connection="own", retries=0)
    with contextlib.suppress(LinkError):
        await stranger.open()
    with pytest.raises(LinkError):
        await stranger.read(["pv"])
    await stranger.close()
    for loop in loops:
        await loop.close()


@pytest.mark.parametrize("fault", ["silent", "drop", "refuse", "wrongtid", "partial", "garbage", "exception=4"])
async def test_libmodbus_faults_reach_each_loop_and_pass(plc, fault):
    port, truth = await plc("--u0", 20)
    loops = [pair_at(port, address, 0, "input", timeout_s=0.2) for address in range(3)]
    for loop in loops:
        await loop.open()
        assert (await loop.read(["output"]))["output"] == 200.0
    await truth.ask(f"fault {fault} 60")
    for seen in await asyncio.gather(*(outcome(loop, lambda seen: isinstance(seen, DriverError)) for loop in loops)):
        assert isinstance(seen, DeviceRefusedError if fault.startswith("exception") else LinkError)
    await truth.ask("clear")
    await asyncio.gather(*(outcome(loop, lambda seen: not isinstance(seen, DriverError)) for loop in loops))
    seen = await asyncio.gather(*(loop.read(["pv", "output"]) for loop in loops))
    assert [one["output"] for one in seen] == [200.0] * 3
    for loop in loops:
        await loop.close()


async def test_a_libmodbus_plc_that_is_killed_takes_all_of_its_loops_along(plc, free_port):
    """Each of them is told; each is served again by the PLC that takes its place."""
    port, truth = await plc("--tcp", free_port, "--u0", 20)
    loops, told = [pair_at(port, address, 0, "input") for address in range(3)], []
    for k, loop in enumerate(loops):
        await loop.open()
        loop.watch(lambda _, k=k: told.append(k))
        await loop.read(["pv"])
    os.kill(truth.pid, signal.SIGKILL)
    seen = await asyncio.gather(*(outcome(loop, lambda seen: isinstance(seen, DriverError)) for loop in loops))
    assert all(isinstance(one, LinkError) for one in seen)
    async with asyncio.timeout(PATIENCE_S):
        while set(told) != {0, 1, 2}:  # noqa: ASYNC110 - a device is only waited for
            await asyncio.sleep(0.02)
    await plc("--tcp", free_port, "--u0", 30)
    for loop in loops:
        await loop.close()
        await loop.open()
    seen = await asyncio.gather(*(loop.read(["pv", "output"]) for loop in loops))
    assert [one["output"] for one in seen] == [300.0] * 3
    for loop in loops:
        await loop.close()
