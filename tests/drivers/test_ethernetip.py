"""The EtherNet/IP driver against a controller on the server of cpppo, which is not the driver's library."""

import importlib.util
import json
import subprocess
import sys

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, LinkError
from autotuner_drivers.ethernetip import create
from autotuner_drivers.testing.conformance import Subject, run
from autotuner_drivers.testing.link import TcpLink

pytest.importorskip("pylogix", reason="the extra ethernetip is not installed")
TAGS = {
    "pv": {"tag": "PV"},
    "output": {"tag": "OUT"},
    "set_point": {"tag": "SP"},
    "kp": {"tag": "KP"},
    "ti": {"tag": "TI"},
    "auto": {"tag": "MODE", "auto_value": [1, 2]},
}


@pytest.fixture
def plc(peers, free_port):
    """The port of the controller; skips without cpppo."""
    if importlib.util.find_spec("cpppo") is None:
        pytest.skip("cpppo is not installed")
    words = [sys.executable, str(peers / "ethernetip_plc.py"), str(free_port), "2", "2", "0.3"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    yield json.loads(process.stdout.readline())["port"]
    process.kill()
    process.wait()
    process.stdout.close()


def here(port, **changes):
    return {"host": "127.0.0.1", "port": port, "timeout_s": 2.0, "tags": TAGS} | changes


@pytest.mark.realtime
async def test_the_driver_conforms_on_the_server_of_cpppo(plc):
    link = TcpLink("127.0.0.1", plc)
    await link.start()
    outcomes = await run(
        Subject(
            lambda: create(here(link.port)), 0.0, 100.0, 5.0, unreachable=lambda: create(here(1)), link=link,
            beyond=(1e39, float("inf")),
        )
    )  # fmt: skip
    await link.close()
    assert [o for o in outcomes if o.passed is not True] == []


@pytest.mark.realtime
async def test_data_types_bits_and_what_does_not_fit(plc):
    more = {"count": {"tag": "COUNT", "scale": 0.1}, "bit": {"tag": "WORD.1"}, "word": {"tag": "WORD"}}
    backend = create(here(plc, tags=TAGS | more))
    await backend.open()
    assert await backend.read(["auto", "count", "bit", "word"]) == {
        "auto": 1.0, "count": pytest.approx(0.7), "bit": 0.0, "word": 5.0,
    }  # fmt: skip
    await backend.write({"count": -3.3, "auto": 0.0, "word": 70000.0})
    assert await backend.read(["auto", "count", "word"]) == {
        "auto": 0.0, "count": pytest.approx(-3.3), "word": 70000.0,
    }  # fmt: skip
    assert backend.limits("count") == pytest.approx((-3276.8, 3276.7))
    assert (backend.limits("bit"), backend.resolution("count", 1.0)) == ((0.0, 1.0), 0.1)
    assert backend.resolution("kp", 1.0) == 2.0**-23
    for signal, value in (("count", 3276.8), ("bit", 2.0), ("word", 2.0**31)):
        with pytest.raises(DeviceRefusedError, match="does not fit the data type"):
            await backend.write({signal: value})
    await backend.close()


@pytest.mark.realtime
async def test_a_tag_that_is_not_there_is_named(plc):
    backend = create(here(plc, tags=TAGS | {"kp": {"tag": "NOPE"}}))
    with pytest.raises(DeviceRefusedError, match="NOPE") as refusal:
        await backend.open()
    assert refusal.value.field == "tags.kp"
    await backend.close()


async def test_nobody_there():
    backend = create(here(1))
    with pytest.raises(LinkError, match="slot 0 cannot be reached"):
        await backend.open()
    await backend.close()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"tags": {"pv": {"tag": "a"}}}, "tags.output"),
        ({"tags": TAGS | {"pv": {}}}, "tags.pv.tag"),
        ({"tags": TAGS | {"auto": {"tag": "a", "auto_value": "Auto"}}}, "tags.auto.auto_value"),
        ({"slot": 18}, "slot"),
        ({"solt": 1}, "solt"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field):
    with pytest.raises(ConfigurationError) as refusal:
        create(here(44818) | change)
    assert refusal.value.field == field
