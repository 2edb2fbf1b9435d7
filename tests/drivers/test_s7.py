"""The S7 driver: hand-worked variables, and a PLC on the server of python-snap7 in a process of its own."""

import json
import math
import subprocess
import sys

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, DriverError
from autotuner_drivers.s7 import Variable, create, plan_reads
from autotuner_drivers.scaling import Scaling
from autotuner_drivers.testing.conformance import Subject, run
from autotuner_drivers.testing.link import TcpLink

pytest.importorskip("snap7", reason="the extra s7 is not installed")
VARIABLES = {
    **{name: {"db": 10, "byte": 4 * k} for k, name in enumerate(("pv", "output", "set_point", "kp", "ti"))},
    "auto": {"db": 10, "byte": 20, "bit": 0},
}


def variable(kind, bit=None, **scaling):
    return Variable("x", "db", 1, 0, bit, kind, Scaling(**scaling))


@pytest.mark.parametrize(
    ("kind", "data", "value"),
    [
        ("real", "42280000", 42.0), ("lreal", "4045000000000000", 42.0),
        ("int", "ff9c", -100.0), ("word", "ff9c", 65436.0),
        ("dint", "fffffffe", -2.0), ("dword", "fffffffe", 4294967294.0), ("byte", "2a", 42.0),
    ],
)  # fmt: skip
def test_variables_by_hand(kind, data, value):
    assert variable(kind).decode(bytes.fromhex(data)) == value
    assert variable(kind).encode(value, b"").hex() == data


def test_scale_bits_and_what_does_not_fit():
    assert variable("int", scale=0.1, offset=5.0).decode(b"\x00\x64") == pytest.approx(15.0)
    assert variable("int", scale=0.1).encode(12.34, b"") == b"\x00\x7b"
    assert [variable("bool", bit).decode(b"\x05") for bit in range(4)] == [1.0, 0.0, 1.0, 0.0]
    assert (variable("bool", 1).encode(1.0, b"\x05"), variable("bool", 0).encode(0.0, b"\x05")) == (b"\x07", b"\x04")
    assert math.isnan(variable("real").decode(bytes.fromhex("7fc00000")))
    for kind, bit, value in (("int", None, 32768.0), ("real", None, 1e39), ("bool", 0, 2.0)):
        with pytest.raises(DeviceRefusedError):
            variable(kind, bit).encode(value, b"\x00")


def test_neighbours_are_read_together():
    def at(area, db, byte):
        return Variable(f"{area}{db}.{byte}", area, db, byte, None, "real", Scaling())

    one, near, far, other, merker = (
        at("db", 1, 8),
        at("db", 1, 204),
        at("db", 1, 208),
        at("db", 2, 0),
        at("merker", 0, 0),
    )
    assert plan_reads([far, merker, near, other, one]) == [[one, near], [far], [other], [merker]]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"variables": {"pv": {"db": 1, "byte": 0}}}, "variables.output"),
        ({"variables": VARIABLES | {"auto": {"db": 1, "byte": 0, "type": "bool"}}}, "variables.auto.bit"),
        ({"variables": VARIABLES | {"pv": {"byte": 0}}}, "variables.pv.db"),
        ({"slot": 32}, "slot"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field):
    with pytest.raises(ConfigurationError) as refusal:
        create({"host": "plc", "variables": VARIABLES} | change)
    assert refusal.value.field == field


@pytest.fixture
def plc(peers, free_port):
    words = [sys.executable, str(peers / "s7_plc.py"), str(free_port), "2", "2", "0.3"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    yield json.loads(process.stdout.readline())["port"]
    process.kill()
    process.wait()
    process.stdout.close()


def here(port, **changes):
    return {"host": "127.0.0.1", "port": port, "timeout_s": 1.0, "variables": VARIABLES} | changes


@pytest.mark.realtime
async def test_the_driver_conforms_on_the_server_of_snap7(plc):
    link = TcpLink("127.0.0.1", plc)
    await link.start()
    outcomes = await run(
        Subject(lambda: create(here(link.port)), 0.0, 100.0, 5.0, unreachable=lambda: create(here(1)), link=link)
    )
    await link.close()
    assert [o for o in outcomes if o.passed is not True] == []


@pytest.mark.realtime
async def test_a_data_block_that_is_not_there_is_an_error(plc):
    backend = create(here(plc, variables=VARIABLES | {"kp": {"db": 77, "byte": 0}}))
    await backend.open()
    with pytest.raises(DriverError):
        await backend.read(["kp"])
    values = await backend.read([name for name in VARIABLES if name != "kp"])
    assert (values["output"], values["ti"], values["auto"]) == (pytest.approx(40.0, abs=1.0), 5.0, 0.0)
    assert set(await backend.read(["pv"])) == {"pv"}
    await backend.close()
