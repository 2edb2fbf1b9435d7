"""The EPICS driver against an IOC of EPICS base, which shares no code with the driver's library."""

import asyncio
import importlib.util
import math
import subprocess
import sys

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, LinkError
from autotuner_drivers.epics import create
from autotuner_drivers.testing.conformance import Subject, run
from autotuner_drivers.testing.link import TcpLink

pytest.importorskip("caproto", reason="the extra epics is not installed")
CHANNELS = {
    "pv": {"name": "TIC:PV"},
    "output": {"name": "TIC:OUT"},
    "set_point": {"name": "TIC:SP"},
    "kp": {"name": "TIC:KP"},
    "ti": {"name": "TIC:TI"},
    "auto": {"name": "TIC:MODE", "auto_value": "Auto", "manual_value": "Manual"},
}


@pytest.fixture
def ioc(peers, free_port):
    """Return a function that starts the IOC and returns its process; skips without softioc."""
    if importlib.util.find_spec("softioc") is None:
        pytest.skip("softioc is not installed")
    running = []

    def start(*words):
        command = [sys.executable, str(peers / "epics_ioc.py"), str(free_port), "2", "2", "0.3", *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        running.append(process)
        assert any(line.startswith("{") for line in process.stdout)
        return process

    yield start
    for process in running:
        process.kill()
        process.wait()
        process.stdout.close()


def here(port, **changes):
    return {"host": "127.0.0.1", "port": port, "timeout_s": 2.0, "channels": CHANNELS} | changes


async def opened(port, channels, **changes):
    backend = create(here(port, channels=CHANNELS | channels, **changes))
    await backend.open()
    return backend


@pytest.mark.realtime
async def test_the_driver_conforms_on_an_ioc_of_epics_base(ioc, free_port):
    ioc()
    link = TcpLink("127.0.0.1", free_port)
    await link.start()
    outcomes = await run(
        Subject(
            lambda: create(here(link.port, search=False)), 0.0, 100.0, 5.0,
            unreachable=lambda: create(here(1, search=False)), link=link, beyond=(-5.0, 150.0, math.inf),
        )
    )  # fmt: skip
    await link.close()
    assert [o for o in outcomes if o.passed is not True] == []


@pytest.mark.realtime
async def test_channels_are_searched_and_what_is_missing_is_named(ioc, free_port):
    ioc()
    backend = await opened(free_port, {})
    assert await backend.read(["auto", "kp", "ti"]) == {"auto": 1.0, "kp": 1.0, "ti": 5.0}
    await backend.close()
    with pytest.raises(LinkError, match="has TIC:NOPE, TIC:NOT"):
        await opened(free_port, {"kp": {"name": "TIC:NOT"}, "ti": {"name": "TIC:NOPE"}}, timeout_s=0.5)
    with pytest.raises(DeviceRefusedError, match="TIC:NOPE"):
        await opened(free_port, {"ti": {"name": "TIC:NOPE"}}, search=False)


@pytest.mark.realtime
async def test_data_types_state_strings_and_limits_of_records(ioc, free_port):
    ioc()
    more = {
        "count": {"name": "TIC:COUNT", "scale": 0.5},
        "state": {"name": "TIC:STATE"},
        "note": {"name": "TIC:NOTE"},
        "auto": {"name": "TIC:STATE", "auto_value": ["Remote"], "manual_value": [0, "Local"]},
    }
    backend = await opened(free_port, more)
    assert await backend.read(["count", "state", "auto"]) == {"count": 3.5, "state": 2.0, "auto": 1.0}
    await backend.write({"count": 10.0})
    assert await backend.read(["count"]) == {"count": 10.0}
    assert backend.resolution("count", 1.0) == 0.5
    assert backend.limits("count") == (-(2.0**30), 2.0**30 - 0.5)
    assert backend.limits("output") == (0.0, 100.0)
    assert 0.0 < backend.resolution("kp", 1.0) < 1e-15
    with pytest.raises(DeviceRefusedError, match="beyond the limits of the record, 0 to 100"):
        await backend.write({"output": 100.5})
    with pytest.raises(DeviceRefusedError, match="a text"):
        await backend.read(["note"])
    await backend.close()


@pytest.mark.realtime
async def test_a_mode_by_its_state_strings(ioc, free_port):
    ioc()
    backend = await opened(free_port, {"raw": {"name": "TIC:MODE"}})
    for value in (0.0, 1.0, 0.0):
        await backend.write({"auto": value})
        assert await backend.read(["auto", "raw"]) == {"auto": value, "raw": value}
    await backend.close()


@pytest.mark.realtime
async def test_a_value_that_the_record_does_not_vouch_for_is_nan(ioc, free_port, caplog):
    ioc("invalid")
    backend = await opened(free_port, {})
    assert math.isnan((await backend.read(["pv"]))["pv"])
    assert "severity INVALID, status READ" in caplog.text
    assert (await backend.read(["output"]))["output"] == pytest.approx(40.0, abs=1.0)
    await backend.close()


@pytest.mark.realtime
async def test_a_timestamp_that_does_not_change_is_noticed(ioc, free_port):
    ioc("stale")
    backend = await opened(free_port, {"pv": {"name": "TIC:PV", "max_age_s": 0.02}})
    assert await backend.read(["pv"]) == {"pv": 80.0}
    async with asyncio.timeout(5.0):
        while not math.isnan((await backend.read(["pv"]))["pv"]):
            pass
    await backend.close()


@pytest.mark.realtime
async def test_a_killed_ioc_is_reported_between_two_calls(ioc, free_port):
    process, gone = ioc(), []
    backend = await opened(free_port, {})
    backend.watch(gone.append)
    process.kill()
    process.wait()
    with pytest.raises(LinkError):
        await backend.read(["pv"])
    assert gone
    await backend.close()


@pytest.mark.realtime
@pytest.mark.parametrize("garbage", [b"", b"\x00" * 64, b"HTTP/1.1 400 Bad Request\r\n\r\n", bytes(range(256))])
async def test_a_server_of_another_protocol_is_a_link_error(free_port, garbage):
    async def answer(_reader, writer):
        writer.write(garbage)
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", free_port):
        backend = create(here(free_port, search=False, timeout_s=0.5))
        with pytest.raises(LinkError):
            await backend.open()
        await backend.close()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"channels": {"pv": {"name": "a"}}}, "channels.output"),
        ({"channels": CHANNELS | {"pv": {}}}, "channels.pv.name"),
        ({"channels": CHANNELS | {"kp": {"name": "a", "scale": 0.0}}}, "channels.kp.scale"),
        ({"port": 0}, "port"),
        ({"serach": True}, "serach"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field):
    with pytest.raises(ConfigurationError) as refusal:
        create(here(5064) | change)
    assert refusal.value.field == field
