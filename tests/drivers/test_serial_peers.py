"""The serial driver on pseudo-terminals against controllers of another make, and our board against a plain port."""

import asyncio
import os
import sys
from functools import reduce
from operator import xor

import pytest
import serial

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner_drivers.serial.backend import create
from tests.control.processes import PATIENCE_S

tty = pytest.importorskip("tty", reason="pseudo-terminals exist on POSIX only")

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals exist on POSIX only"),
]

TEMPLATE = {
    "pv": {"read": "PV?", "valid": [-50.0, 300.0]},
    "output": {"read": "OUT?", "write": "OUT {output:.2f}", "confirm": "OK"},
}
PROTOCOLS = {
    "tclab": {"protocol": "tclab"},
    "lakeshore": {"protocol": "lakeshore"},
    "eurotherm": {"protocol": "eurotherm"},
    "simple": {"protocol": "template", "signals": TEMPLATE, "error": "ERR.*"},
}


@pytest.fixture
def connect(peer, tmp_path):
    """Return a function that starts a peer and returns a closed backend for it."""

    def start(protocol, *arguments, **options):
        port = tmp_path / "ttyPEER"
        peer("serial_peer.py", "--protocol", protocol, "--link", port, "--plant", 2, 1, 0.1, *arguments)
        loop = create({"serial_port": str(port), "timeout_s": 0.3} | PROTOCOLS[protocol] | options)
        loop._protocol.settle_s = 0.0  # the peers' boards do not reset
        return loop

    return start


@pytest.mark.parametrize("protocol", PROTOCOLS)
async def test_the_output_moves_the_pv(connect, protocol):
    loop = connect(protocol, "--speed", 10)
    await loop.open()
    first = await loop.read(["pv", "output"])
    await loop.write({"output": 30.0})
    async with asyncio.timeout(PATIENCE_S):
        while True:
            if (await loop.read(["pv"]))["pv"] > 79.0:
                break
            await asyncio.sleep(0.05)
    last = await loop.read(["output"])
    await loop.write({"output": 0.0})
    await loop.close()
    assert first == {"pv": 20.0, "output": 0.0}
    assert last == {"output": 30.0}


async def test_eurotherm_auto_is_taken_and_given_back(connect):
    loop = connect("eurotherm")
    await loop.open()
    await loop.write({"auto": 1.0, "set_point": 55.5})
    assert await loop.read(["auto", "set_point"]) == {"auto": 1.0, "set_point": 55.5}
    with pytest.raises(DeviceRefusedError, match=r"not acknowledged|the device holds"):
        await loop.write({"output": 30.0})
    await loop.write({"auto": 0.0, "output": 30.0, "kp": 25.0})
    assert await loop.read(["auto", "output", "kp"]) == {"auto": 0.0, "output": 30.0, "kp": 25.0}
    await loop.close()


async def test_lakeshore_leaves_the_heater_off_as_it_was_found(connect):
    loop = connect("lakeshore")
    await loop.open()
    await loop.write({"output": 30.0})
    assert (await loop.read(["output"]))["output"] == 30.0
    await loop.close()
    await loop.open()
    assert (await loop.read(["output"]))["output"] == 0.0
    await loop.close()


@pytest.mark.parametrize("protocol", ["tclab", "lakeshore", "eurotherm"])
async def test_a_broken_sensor_is_nan(connect, protocol):
    loop = connect(protocol, "--fault", "over@0+60")
    await loop.open()
    pv = (await loop.read(["pv"]))["pv"]
    await loop.close()
    assert pv != pv  # noqa: PLR0124 - NaN alone differs from itself


@pytest.mark.parametrize(
    ("protocol", "fault"),
    [
        ("tclab", "cut"),
        ("tclab", "error"),
        ("lakeshore", "slow=0.5"),
        ("eurotherm", "garble=0.3"),
        ("eurotherm", "error"),
        ("simple", "silent"),
    ],
)
async def test_faults_end_in_typed_errors_and_pass(connect, protocol, fault):
    # The peer counts from its own start: a busy machine opens the port and reads well within 2 s.
    loop = connect(protocol, "--fault", f"{fault}@2.0+0.8", retries=0, late_answer_s=0.3)
    await loop.open()
    assert (await loop.read(["pv"]))["pv"] == 20.0
    errors, good = [], 0
    async with asyncio.timeout(PATIENCE_S):
        while not (errors and good >= 3):
            await asyncio.sleep(0.02)
            try:
                seen = (await loop.read(["output"]))["output"]
            except DriverError as error:
                errors.append(error)
                good = 0
            else:
                assert seen == 0.0 or fault.startswith("garble")  # one damaged digit is still a number
                good += 1
    await loop.close()
    assert all(isinstance(error, LinkError | DeviceRefusedError) for error in errors)
    assert all(error.remedy for error in errors)


async def test_a_port_that_is_not_there(tmp_path):
    with pytest.raises(LinkError, match="ttyNONE does not exist"):
        await create(PROTOCOLS["eurotherm"] | {"serial_port": str(tmp_path / "ttyNONE")}).open()


async def test_blocking_calls_do_not_hold_up_the_loop(connect):
    """While a slow device is waited for, the loop goes on: the longest time between two turns is short."""
    loop = connect("tclab", "--fault", "slow=0.25@0.5+60", timeout_s=1.0)
    await loop.open()
    await asyncio.sleep(0.6)
    clock, turns = asyncio.get_running_loop().time, []
    reading = asyncio.create_task(loop.read(["pv"]))
    while not reading.done():
        turns.append(clock())
        await asyncio.sleep(0.005)
    assert (await reading)["pv"] == 20.0
    assert len(turns) > 10
    await loop.close()


async def test_our_board_speaks_to_a_plain_serial_port(tmp_path):
    from autotuner_sim.devices.serial_board import serving_board
    from autotuner_sim.devices.tclab_board import TclabBoard
    from autotuner_sim.plants import Fopdt
    from autotuner_sim.stepped import SteppedPlant

    def talk():
        with serial.Serial(str(tmp_path / "ttyLAB"), 115200, timeout=3.0) as port:
            port.read(1)  # the reset: silence
            port.timeout = PATIENCE_S
            return [port.write(command) and port.readline() for command in (b"VER\r\n", b"Q1 30\n", b"R1\n", b"T1\n")]

    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), pv0=23.0)
    async with serving_board(TclabBoard(plant), tmp_path / "ttyLAB"):
        answers = await asyncio.to_thread(talk)
    assert answers[0].startswith(b"TCLab Firmware")
    assert answers[1:3] == [b"30.000\r\n", b"30.000\r\n"]
    assert float(answers[3]) == pytest.approx(23.0, abs=0.1)
    assert not (tmp_path / "ttyLAB").is_symlink()


class CountingBoard:
    """A board on a pseudo-terminal: whole tenths, modes by name, `$message*checksum`; every third answer is damaged."""

    def __init__(self):
        self.ours, self.theirs = os.openpty()
        tty.setraw(self.theirs)
        self.port, self.held, self.answers, self._buffer = os.ttyname(self.theirs), {"OUT": "0000", "MD": "MAN"}, 0, b""
        asyncio.get_running_loop().add_reader(self.ours, self.receive)

    def receive(self):
        *lines, self._buffer = (self._buffer + os.read(self.ours, 1024)).split(b"\r")
        for line in lines:
            message, _, check = line.decode().removeprefix("$").partition("*")
            if int(check, 16) == reduce(xor, message.encode()):
                self.answer(message)

    def answer(self, message):
        name, _, value = message.partition(" ")
        if value:
            self.held[name] = value
        text = {"T?": "0235"}.get(message) or self.held[name.rstrip("?")]
        self.answers += 1
        check = reduce(xor, text.encode()) ^ (self.answers % 3 == 0)
        os.write(self.ours, f"${text}*{check:02x}\r\n".encode())

    def close(self):
        asyncio.get_running_loop().remove_reader(self.ours)
        os.close(self.ours)
        os.close(self.theirs)


async def test_a_board_that_counts_in_tenths_and_checks_every_message():
    board = CountingBoard()
    signals = {
        "pv": {"read": "$T?", "answer": r"\$(\d+)", "scale": 0.1},
        "output": {
            "read": "$OUT?", "answer": r"\$(\d+)", "write": "$OUT {output:04.0f}", "confirm": ".*", "scale": 0.1,
        },
        "auto": {
            "read": "$MD?", "answer": r"\$(\w+)", "write": "$MD {auto}", "confirm": ".*",
            "auto_value": "AUTO", "manual_value": "MAN",
        },
    }  # fmt: skip
    loop = create(
        {
            "serial_port": board.port, "protocol": "template", "line_end": "\r", "timeout_s": 0.2,
            "late_answer_s": 0.05, "signals": signals, "checksum": {"kind": "xor", "before": "*", "skip": 1},
        }
    )  # fmt: skip
    await loop.open()
    for value in (12.3, 45.6):
        await loop.write({"auto": 1.0, "output": value})
        assert await loop.read(["pv", "output", "auto"]) == {"pv": 23.5, "output": pytest.approx(value), "auto": 1.0}
    await loop.write({"auto": 0.0})
    await loop.close()
    board.close()
    assert board.held == {"OUT": "0456", "MD": "MAN"}
    assert loop.repeated > 0
