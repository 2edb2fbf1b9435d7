"""RTU on pseudo-terminals: libmodbus as the slave, mbpoll as the master, and a bad wire in between."""

import asyncio
import os
import shutil
import sys

import pytest
import serial

from autotuner.errors import ConfigurationError, DriverError, LinkError
from autotuner_drivers.modbus.backend import create
from tests.control.processes import PATIENCE_S

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals exist on POSIX only"),
]


@pytest.fixture
def slave(peer, tmp_path):
    """Return a function that starts the libmodbus PLC as unit 7 at 9600 8E1 and returns the port for its master."""

    def start(*arguments, bad_wire=()):
        port = tmp_path / "ttyPLC"
        peer(
            "plc_libmodbus.py", "--rtu-link", port, "--unit", 7, "--baud", 9600, "--parity", "E",
            "--plant", 2, 10, 1.5, "--u0", 30, *arguments,
        )  # fmt: skip
        if not bad_wire:
            return port
        chaos = [word for rule in bad_wire for word in ("--chaos", rule)]
        peer("chaos_proxy.py", "--link", tmp_path / "ttyBAD", "--device", port, "--seed", 1, *chaos)
        return tmp_path / "ttyBAD"

    return start


def backend(port, registers, **options):
    line = {"transport": "rtu", "serial_port": str(port), "baudrate": 9600, "parity": "E", "unit": 7}
    return create(line | {"timeout_s": 0.3, "registers": registers, "max_gap": 8} | options)


async def until(loop, wanted):
    """Read until the outcome (values or an error) is as wanted; return it."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                seen = await loop.read(["pv", "output"])
            except DriverError as error:
                seen = error
            if wanted(seen):
                return seen
            await asyncio.sleep(0.05)


def is_value(seen):
    return isinstance(seen, dict)


async def through(port, reader, writer):
    """A transparent gateway: bytes of one TCP connection to and from a serial port."""
    line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    asyncio.get_running_loop().add_reader(line, lambda: writer.write(os.read(line, 256)))
    try:
        while data := await reader.read(256):
            os.write(line, data)
    finally:
        asyncio.get_running_loop().remove_reader(line)
        os.close(line)
        writer.close()


async def test_libmodbus_through_a_transparent_gateway(slave, default_map):
    port = slave()
    gateway = await asyncio.start_server(lambda *ends: through(port, *ends), "127.0.0.1", 0)
    async with gateway:
        tcp = {"transport": "rtu_over_tcp", "host": "127.0.0.1", "port": gateway.sockets[0].getsockname()[1], "unit": 7}
        loop = create(tcp | {"timeout_s": 0.3, "registers": default_map})
        await loop.open()
        written = {"output": 41.7, "kp": 2.5, "auto": 1.0}
        await loop.write(written)
        assert await loop.read(["pv", "kp", "auto"]) == {"pv": 80.0, "kp": 2.5, "auto": 1.0}
        await loop.close()
        gateway.close()
        await asyncio.sleep(0.1)  # the gateway hangs up too


async def test_libmodbus_at_9600_8e1(slave, default_map):
    loop = backend(slave(), default_map)
    await loop.open()
    before = await loop.read(loop.readable)
    assert (before["pv"], before["output"], before["auto"]) == (80.0, 30.0, 0.0)
    written = {"output": 41.7, "kp": 2.5, "ti": 12.0, "td": 0.25, "set_point": 60.0}
    await loop.write(written)
    assert await loop.read(written) == pytest.approx(written)
    await loop.write({"auto": 1.0})
    assert await loop.read(["auto"]) == {"auto": 1.0}
    await loop.close()


async def test_a_port_in_use_and_a_port_that_is_not_there(slave, default_map, tmp_path):
    port = slave()
    first = backend(port, default_map)
    with serial.Serial(str(port), exclusive=True), pytest.raises(LinkError, match="in use by another program"):
        await first.open()
    await first.open()
    with pytest.raises(LinkError, match="ttyNONE unit 7 does not exist"):
        await backend(tmp_path / "ttyNONE", default_map).open()
    assert (await first.read(["pv"]))["pv"] == 80.0
    await first.close()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may open every port")
async def test_a_port_without_permission(default_map, tmp_path):
    port = tmp_path / "ttyLOCKED"
    port.touch(mode=0o000)
    with pytest.raises(LinkError, match="permission denied"):
        await backend(port, default_map).open()


async def test_a_file_that_is_no_port(default_map, tmp_path):
    file = tmp_path / "notes.txt"
    file.touch()
    with pytest.raises(LinkError, match=r"notes\.txt"):
        await backend(file, default_map).open()


async def test_unplug_and_replug(slave, default_map):
    loop = backend(slave(bad_wire=["unplug@1.0+0.6"]), default_map)
    await loop.open()
    assert await until(loop, is_value) == {"pv": 80.0, "output": 30.0}
    assert isinstance(await until(loop, lambda seen: not is_value(seen)), LinkError)
    assert await until(loop, is_value) == {"pv": 80.0, "output": 30.0}
    await loop.close()


async def test_the_echo_of_a_two_wire_adapter(slave, default_map):
    loop = backend(slave(bad_wire=["echo"]), default_map, echo=True)
    await loop.open()
    for output in (31.0, 32.0, 33.0):
        await loop.write({"output": output})
        assert await loop.read(["output"]) == {"output": output}
    await loop.close()


async def test_corrupted_bytes_never_become_values(slave, default_map):
    """The plant rests at 80 and 30, so any other value would have come from a damaged answer."""
    loop = backend(slave(bad_wire=["corrupt=0.01"]), default_map, retries=3)
    await loop.open()
    seen = []
    for _ in range(30):
        try:
            seen.append(await loop.read(["pv", "output"]))
        except LinkError:
            continue
    await loop.close()
    assert len(seen) > 25
    assert all(values == {"pv": 80.0, "output": 30.0} for values in seen)


async def test_mbpoll_as_the_master_of_our_slave(tmp_path):
    mbpoll = shutil.which("mbpoll")
    if mbpoll is None:
        pytest.skip("mbpoll is not installed")
    from autotuner_sim.devices.loop_device import LoopDevice
    from autotuner_sim.devices.plc import SimulatedPlc, serving_rtu
    from autotuner_sim.devices.serial_wire import joined_ports
    from autotuner_sim.plants import Fopdt
    from autotuner_sim.stepped import SteppedPlant

    async def poll(unit, *arguments):
        process = await asyncio.create_subprocess_exec(
            mbpoll, "-m", "rtu", "-b", "9600", "-P", "none", "-a", str(unit), "-0", "-1", "-o", "0.5", *arguments,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        output, _ = await process.communicate()
        return process.returncode, output.decode()

    device = LoopDevice(SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0))
    port = tmp_path / "ttyOURS"
    async with joined_ports(port) as near, serving_rtu(SimulatedPlc(device), near, 7):
        code, printed = await poll(7, "-r", "0", "-c", "2", "-t", "3", str(port))
        assert code == 0
        assert "[0]: \t800" in printed
        assert "[1]: \t400" in printed
        assert (await poll(7, "-r", "0", "-t", "4", str(port), "455"))[0] == 0
        assert device.output == 45.5
        code, printed = await poll(8, "-r", "0", "-c", "1", "-t", "3", str(port))
        assert code != 0
        assert "timed out" in printed
    assert not port.is_symlink()


@pytest.mark.parametrize(
    ("options", "key", "value"),
    [
        ({"unit": 0}, "unit", 0),
        ({"unit": 248}, "unit", 248),
        ({"parity": "even"}, "parity", "even"),
        ({"stopbits": 3}, "stopbits", 3),
        ({"baudrate": 0}, "baudrate", 0),
        ({"bytesize": 7}, "bytesize", 7),
        ({"serial_port": ""}, "serial_port", ""),
        ({"host": "127.0.0.1"}, "host", "127.0.0.1"),
        ({"transport": "usb"}, "transport", "usb"),
        ({"late_answer_s": -1.0}, "late_answer_s", -1.0),
        ({"gap_s": 0.0}, "gap_s", 0.0),
        ({"echo": "yes"}, "echo", "yes"),
        ({"timeout_s": 0.0}, "timeout_s", 0.0),
        ({"retries": 1.5}, "retries", 1.5),
    ],
)
def test_line_options_are_refused_by_key_value_and_remedy(default_map, options, key, value):
    with pytest.raises(ConfigurationError) as refusal:
        backend("/dev/ttyUSB0", default_map, **options)
    assert (refusal.value.field, refusal.value.value) == (key, value)
    assert refusal.value.remedy
