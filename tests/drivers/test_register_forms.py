"""Register maps of devices that want more than a number in a register, each against a server that behaves so.

The server is pyModbusTCP's, which shares no code with ours; that of Modbus ASCII is written here by the standard.
"""

import asyncio
import math
import threading

import pytest
from pyModbusTCP.server import DataBank, DataHandler, ModbusServer

from autotuner.errors import ConfigurationError, DeviceRefusedError, LinkError
from autotuner_drivers.modbus import create
from autotuner_drivers.modbus.register_map import read_map
from autotuner_drivers.options import Options

pytestmark = pytest.mark.realtime
PV = {"table": "input", "address": 0, "scale": 0.1}
OUTPUT = {"table": "holding", "address": 0, "scale": 0.1}
MODE = {"table": "holding", "address": 20, "auto_value": [1, 3, 4], "manual_value": [0, 2]}

PULSE = {"table": "coil", "address": 1}


class Recorder(DataHandler):
    """Keeps the requests with their unit; what a unit holds is kept apart where `by_unit`."""

    def __init__(self, bank):
        super().__init__(bank)
        self.writes, self.units = [], []

    def write_h_regs(self, address, words_l, srv_info):
        self.writes.append((address, list(words_l)))
        self.units.append(srv_info.recv_frame.mbap.unit_id)
        return super().write_h_regs(address, words_l, srv_info)

    def read_i_regs(self, address, count, srv_info):
        self.units.append(srv_info.recv_frame.mbap.unit_id)
        return super().read_i_regs(address, count, srv_info)


@pytest.fixture
def device(free_port):
    """Return a function that serves a bank; and the handler that keeps its requests."""
    before, servers = set(threading.enumerate()), []

    def start(bank=None):
        handler = Recorder(bank or DataBank())
        server = ModbusServer("127.0.0.1", free_port, no_block=True, data_hdl=handler)
        server.start()
        servers.append(server)
        return handler

    yield start
    for server in servers:
        server.stop()
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)


async def opened(port, registers, **options):
    backend = create(
        {"host": "127.0.0.1", "port": port, "registers": {"pv": PV, "output": OUTPUT} | registers} | options
    )
    await backend.open()
    return backend


async def test_a_bit_of_a_word_leaves_its_neighbours_alone(device, free_port):
    bank = device().data_bank
    bank.set_holding_registers(5, [0b1010_0000_0000_0101])
    words = {"table": "holding", "address": 5}
    backend = await opened(
        free_port, {"auto": words | {"bit": 3}, "alarm": words | {"bit": 15}, "run": words | {"bit": 0}}
    )
    assert await backend.read(["auto", "alarm", "run"]) == {"auto": 0.0, "alarm": 1.0, "run": 1.0}
    await backend.write({"auto": 1.0})
    assert bank.get_holding_registers(5, 1) == [0b1010_0000_0000_1101]
    await backend.write({"run": 0.0})
    assert bank.get_holding_registers(5, 1) == [0b1010_0000_0000_1100]
    assert backend.limits("run") == (0.0, 1.0)
    await backend.close()


async def test_several_values_mean_automatic(device, free_port):
    bank = device().data_bank
    backend = await opened(free_port, {"auto": MODE})
    seen = []
    for raw in (0, 1, 2, 3, 4):
        bank.set_holding_registers(20, [raw])
        seen.append((await backend.read(["auto"]))["auto"])
    assert seen == [0.0, 1.0, 0.0, 1.0, 1.0]
    bank.set_holding_registers(20, [9])
    with pytest.raises(DeviceRefusedError, match=r"neither 1, 3, 4 \(1.0\) nor 0, 2"):
        await backend.read(["auto"])
    await backend.write({"auto": 1.0})
    assert bank.get_holding_registers(20, 1) == [1]
    await backend.close()


class Pulsed(DataBank):
    """Two coils that the device clears as it changes its mode; input 9 is the mode."""

    def on_coils_change(self, address, from_value, to_value, srv_info):
        if to_value and address in {10, 11}:
            self.set_discrete_inputs(9, [address == 10])
            self.set_coils(address, [False])


async def test_pulse_commands(device, free_port):
    bank = device(Pulsed()).data_bank
    mode = {
        "table": "discrete",
        "address": 9,
        "auto_pulse": {"table": "coil", "address": 10},
        "manual_pulse": {"table": "coil", "address": 11},
    }
    backend = await opened(free_port, {"auto": mode})
    assert "auto" in backend.writable
    for value in (1.0, 0.0, 1.0):
        await backend.write({"auto": value})
        assert await backend.read(["auto"]) == {"auto": value}
        assert bank.get_coils(10, 2) == [False, False]
    await backend.close()


async def test_a_unit_of_its_own_for_a_register(device, free_port):
    handler = device()
    handler.data_bank.set_input_registers(0, [215, 333])
    far = {"table": "input", "address": 1, "scale": 0.1, "unit": 7}
    backend = await opened(free_port, {"far": far, "gain": {"table": "holding", "address": 3, "unit": 9}}, unit=2)
    assert await backend.read(["pv", "far"]) == {"pv": 21.5, "far": pytest.approx(33.3)}
    await backend.write({"output": 1.0, "gain": 4.0})
    await backend.close()
    assert sorted(handler.units) == [2, 2, 7, 9]


async def test_binary_coded_decimals(device, free_port):
    bank = device().data_bank
    bank.set_holding_registers(30, [0x1234, 0x0001, 0x2345])
    signals = {
        "a": {"table": "holding", "address": 30, "type": "bcd16", "scale": 0.1},
        "b": {"table": "holding", "address": 31, "type": "bcd32"},
    }
    backend = await opened(free_port, signals, odd_addresses=True)
    assert await backend.read(["a", "b"]) == {"a": pytest.approx(123.4), "b": 12345.0}
    await backend.write({"a": 98.7, "b": 7654321.0})
    assert bank.get_holding_registers(30, 3) == [0x0987, 0x0765, 0x4321]
    with pytest.raises(DeviceRefusedError, match="does not fit bcd16"):
        await backend.write({"a": 1000.0})
    bank.set_holding_registers(30, [0x12A4])
    assert math.isnan((await backend.read(["a"]))["a"])
    await backend.close()


async def test_an_output_that_is_written_here_and_read_there(device, free_port):
    bank = device().data_bank
    bank.set_input_registers(1, [400])
    output = {"table": "input", "address": 1, "scale": 0.1, "write": {"table": "holding", "address": 8}}
    backend = await opened(free_port, {"output": output})
    assert await backend.read(["output"]) == {"output": 40.0}
    await backend.write({"output": 55.5})
    assert bank.get_holding_registers(8, 1) == [555]
    assert await backend.read(["output"]) == {"output": 40.0}
    await backend.close()


@pytest.mark.parametrize("heartbeat", [{"table": "coil", "address": 4}, {"table": "holding", "address": 4, "bit": 2}])
async def test_a_heartbeat_that_toggles(device, free_port, heartbeat):
    bank = device().data_bank
    backend = await opened(free_port, {"heartbeat": heartbeat})
    held = []
    for _ in range(4):
        await backend.read(["pv"])
        held.append(bank.get_coils(4, 1)[0] or bool(bank.get_holding_registers(4, 1)[0]))
    assert held in ([True, False, True, False], [False, True, False, True])
    await backend.close()
    assert (bank.get_coils(4, 1), bank.get_holding_registers(4, 1)) == ([False], [0])


GAINS = {
    name: {"table": "holding", "address": 40 + 2 * k, "type": "float32"} for k, name in enumerate(("kp", "ti", "td"))
}


async def test_registers_that_are_written_in_one_request(device, free_port):
    handler = device()
    backend = await opened(free_port, GAINS, write_together=[["td", "kp", "ti"]])
    await backend.write({"kp": 2.0, "ti": 8.0, "td": 0.5, "output": 1.0})
    assert handler.writes == [(40, [0x4000, 0, 0x4100, 0, 0x3F00, 0]), (0, [10])]
    handler.writes.clear()
    await backend.write({"ti": 16.0})
    assert handler.writes == [(40, [0x4000, 0, 0x4180, 0, 0x3F00, 0])]
    await backend.close()


class Committing(DataBank):
    """Takes the gains over once bit 1 of register 50 is set, and then clears it."""

    taken = None
    deaf = False

    def on_holding_registers_change(self, address, from_value, to_value, srv_info):
        if address == 50 and to_value & 2 and not self.deaf:
            self.taken = self.get_holding_registers(40, 6)
            self.set_holding_registers(50, [to_value & ~2])


async def test_a_handshake_bit(device, free_port, monkeypatch):
    bank = device(Committing()).data_bank
    bank.set_holding_registers(50, [0b1000])
    shake = {"table": "holding", "address": 50, "bit": 1, "signals": ["kp", "ti", "td"]}
    backend = await opened(free_port, GAINS, handshake=shake)
    await backend.write({"output": 5.0})
    assert bank.taken is None
    await backend.write({"kp": 2.0, "ti": 8.0, "td": 0.5})
    assert bank.taken == [0x4000, 0, 0x4100, 0, 0x3F00, 0]
    assert bank.get_holding_registers(50, 1) == [0b1000]
    bank.deaf = True
    monkeypatch.setattr("autotuner_drivers.modbus.backend.HANDSHAKE_S", 0.3)
    with pytest.raises(DeviceRefusedError, match="has not cleared the handshake at holding 50 bit 1"):
        await backend.write({"kp": 3.0})
    await backend.close()


async def ascii_device(reader, writer):
    """Modbus ASCII by the standard: `:`, hexadecimal digits, the two's complement of the sum of the bytes, CR LF."""
    held = [400, 215]
    while line := await reader.readline():
        frame = bytes.fromhex(line.strip().removeprefix(b":").decode())
        assert sum(frame) % 256 == 0
        unit, function, address, value = frame[0], frame[1], *(int.from_bytes(frame[k : k + 2], "big") for k in (2, 4))
        if function == 6:
            held[address], answer = value, frame[:6]
        else:
            words = held[address : address + value] if function == 3 else [held[1]]
            answer = bytes([unit, function, 2 * len(words), *(b for word in words for b in word.to_bytes(2, "big"))])
        damaged = value == 999
        check = (-sum(answer) + damaged) % 256
        writer.write(b":" + (answer + bytes([check])).hex().upper().encode() + b"\r\n")
        await writer.drain()
    writer.close()


async def test_modbus_ascii_through_a_gateway(free_port):
    server = await asyncio.start_server(ascii_device, "127.0.0.1", free_port)
    async with server:
        backend = await opened(free_port, {}, transport="ascii_over_tcp", unit=17, timeout_s=0.5, retries=0)
        assert await backend.read(["pv", "output"]) == {"pv": 21.5, "output": 40.0}
        await backend.write({"output": 12.3})
        assert await backend.read(["output"]) == {"output": pytest.approx(12.3)}
        with pytest.raises(LinkError):
            await backend.write({"output": 99.9})
        assert (await backend.read(["output"]))["output"] == pytest.approx(99.9)
        await backend.close()
        await asyncio.sleep(0.2)  # the device hangs up too


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"registers": {"a": {"table": "holding", "address": 1, "bit": 16}}}, "registers.a.bit"),
        ({"registers": {"a": {"table": "holding", "address": 1, "type": "float32", "bit": 1}}}, "registers.a.bit"),
        ({"registers": {"auto": MODE | {"manual_value": [3]}}}, "registers.auto.auto_value"),
        ({"registers": {"auto": MODE | {"auto_value": [70000]}}}, "registers.auto.auto_value"),
        (
            {"registers": {"auto": MODE | {"auto_pulse": {"table": "coil", "address": 1}}}},
            "registers.auto.manual_pulse",
        ),
        ({"write_together": [["output", "nothing"]]}, "write_together"),
        ({"registers": GAINS, "write_together": [["kp", "td"]]}, "write_together"),
        ({"handshake": {"table": "coil", "address": 1, "signals": ["nothing"]}}, "handshake.signals"),
    ],
)
def test_a_map_that_cannot_work_is_refused_with_its_key(change, field):
    registers = {"pv": PV, "output": OUTPUT} | change.pop("registers", {})
    with pytest.raises(ConfigurationError) as refusal:
        read_map(Options({"registers": registers} | change))
    assert refusal.value.field == field
