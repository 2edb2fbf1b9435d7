"""The MQTT driver: hand-worked payloads, and devices behind the broker mosquitto."""

import asyncio
import contextlib
import json
import math
import shutil
import signal
import subprocess
import sys

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, DriverError, LinkError
from autotuner_drivers.mqtt import create
from autotuner_drivers.mqtt.topics import read_signals, value_of
from autotuner_drivers.options import Options
from autotuner_drivers.testing.conformance import Subject, run
from autotuner_drivers.testing.link import TcpLink
from tests.control.processes import PATIENCE_S

aiomqtt = pytest.importorskip("aiomqtt", reason="the extra mqtt is not installed")
MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/opt/homebrew/sbin") or shutil.which("mosquitto")
TOPICS = {
    "pv": {"topic": "dev/sensor", "json": "DS18B20.Temperature"},
    "output": {"topic": "dev/out", "json": "out", "command": "dev/out/set", "payload": "{value:.2f}"},
    "auto": {"topic": "dev/mode", "command": "dev/mode/set", "auto_value": ["auto", "heat"], "manual_value": "off"},
    **{
        name: {"topic": f"dev/{topic}", "command": f"dev/{topic}/set"}
        for name, topic in {"set_point": "sp", "kp": "kp", "ti": "ti"}.items()
    },
}


def signal_of(name="pv", **keys):
    table = {
        "topics": {"pv": {"topic": "t"}, "output": {"command": "c"}} | {name: {"topic": "t", "command": "c"} | keys}
    }
    return read_signals(Options(table))[name]


@pytest.mark.parametrize(
    ("keys", "payload", "value", "reason"),
    [
        ({}, b"23.5", 23.5, ""),
        ({"scale": 0.1, "offset": 1.0}, b" 235 ", 24.5, ""),
        ({"json": "a.b"}, b'{"a": {"b": 23.5}}', 23.5, ""),
        ({"json": "a.1.b"}, b'{"a": [0, {"b": "23.5"}]}', 23.5, ""),
        ({"json": "a.b"}, b'{"a": {}}', math.nan, "has no a.b"),
        ({"json": "a.b"}, b"[1]", math.nan, "has no a.b"),
        ({"json": "a"}, b'{"a": null}', math.nan, "not a number"),
        ({"json": "a"}, b'{"a": [1]}', math.nan, "no value"),
        ({}, b"unavailable", math.nan, "not a number"),
        ({}, b"nan", math.nan, "not a number"),
        ({}, b"", math.nan, "not a number"),
        ({}, b"\xff\xfe", math.nan, "has no text"),
        ({"json": "a"}, b'{"a": 1e999}', math.inf, "not a number"),
    ],
)
def test_payloads_by_hand(keys, payload, value, reason):
    seen, why = value_of(signal_of(**keys), payload)
    assert seen == pytest.approx(value, nan_ok=True)
    assert reason in why
    assert bool(why) == bool(reason)


@pytest.mark.parametrize(
    ("keys", "value", "text", "step"),
    [
        ({}, 40.0, "40.0", 0.0),
        ({"payload": "{value:.1f}"}, 40.04, "40.0", 0.1),
        ({"payload": '{"brightness": {value:.0f}, "x": {}}', "scale": 0.5}, 40.0, '{"brightness": 80, "x": {}}', 0.5),
    ],
)
def test_commands_by_hand(keys, value, text, step):
    output = signal_of("output", **keys)
    assert (output.text(value), output.step) == (text, step)


def test_modes_are_texts():
    mode = signal_of("auto", auto_value=["heat", "auto"], manual_value="off")
    assert [value_of(mode, text)[0] for text in (b"heat", b"AUTO", b"off")] == [1.0, 1.0, 0.0]
    assert (mode.text(1.0), mode.text(0.0)) == ("heat", "off")
    assert math.isnan(value_of(mode, b"defrost")[0])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"interval_s": 0.0}, "interval_s"),
        ({"topics": {"pv": {"topic": "t"}}}, "topics.output.command"),
        ({"topics": {"pv": {"command": "t"}, "output": {"command": "c"}}}, "topics.pv.topic"),
        ({"topics": {"pv": {"topic": "t/#"}, "output": {"command": "c"}}}, "topics.pv.topic"),
        ({"topics": {"pv": {"topic": "t"}, "output": {"command": "c", "payload": "on"}}}, "topics.output.payload"),
        (
            {"topics": {"pv": {"topic": "t"}, "output": {"command": "c", "payload": "{value:q}"}}},
            "topics.output.payload",
        ),
        ({"will": {"online": "x"}}, "will.topic"),
        ({"tls": True, "ca_file": "/no/such/file"}, "ca_file"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field):
    topics = {"pv": {"topic": "t"}, "output": {"command": "c"}}
    with pytest.raises(ConfigurationError) as refusal:
        create({"host": "h", "interval_s": 1.0, "topics": topics} | change)
    assert refusal.value.field == field


@pytest.fixture
def broker(tmp_path, free_port):
    """Return a function that starts mosquitto with lines of configuration; yields its port."""
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed")
    with contextlib.ExitStack() as running:

        def start(*lines):
            file = tmp_path / "mosquitto.conf"
            usual = (
                f"listener {free_port} 127.0.0.1",
                "allow_anonymous true",
                f"user {__import__('getpass').getuser()}",
            )
            file.write_text("\n".join(lines or usual) + "\n", encoding="utf-8")
            process = subprocess.Popen([MOSQUITTO, "-c", str(file)], stderr=subprocess.DEVNULL)
            running.callback(process.wait)
            running.callback(process.kill)
            return process

        yield start


@pytest.fixture
def device(free_port, peers):
    """Return a function that starts the device and waits until the broker has it."""
    with contextlib.ExitStack() as running:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, str(peers / "mqtt_device.py"), str(free_port), "2", "2", "0.3", *arguments],
                stdout=subprocess.PIPE,
                text=True,
            )
            running.callback(process.stdout.close)
            running.callback(process.wait)
            running.callback(process.kill)
            assert json.loads(process.stdout.readline())["ready"]
            return process

        yield start


async def listening(port):
    async with asyncio.timeout(PATIENCE_S):
        while True:
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.close()
                return
            await asyncio.sleep(0.05)


async def read_on(backend):
    """Read again and again: the end of a connection takes a moment to be seen."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await backend.read(["pv"])
            await asyncio.sleep(0.02)


async def opened_by(client, opening, pv):
    """Publish a PV until the open has it: nothing tells when its subscription is in force."""
    while not opening.done():
        await client.publish("dev/sensor", json.dumps({"DS18B20": {"Temperature": pv}}), 1)
        await asyncio.sleep(0.05)
    await opening


def here(port, **changes):
    return {"host": "127.0.0.1", "port": port, "interval_s": 1.0, "timeout_s": 2.0, "topics": TOPICS} | changes


@contextlib.asynccontextmanager
async def opened(options):
    backend = create(options)
    await backend.open()
    try:
        yield backend
    finally:
        await backend.close()


@pytest.mark.realtime
async def test_the_driver_conforms_behind_mosquitto(broker, device, free_port):
    broker()
    await listening(free_port)
    device()
    link = TcpLink("127.0.0.1", free_port)
    await link.start()
    subject = Subject(
        lambda: create(here(link.port)), 0.0, 100.0, 5.0,
        beyond=(1000.0, -1000.0), unreachable=lambda: create(here(1)), link=link,
    )  # fmt: skip
    outcomes = await run(subject)
    await link.close()
    assert [o for o in outcomes if o.passed is not True] == []


@pytest.mark.realtime
async def test_a_retained_pv_is_no_measurement_and_a_retained_state_is_one(broker, free_port):
    broker()
    await listening(free_port)
    async with aiomqtt.Client("127.0.0.1", free_port) as client:
        await client.publish("dev/sensor", '{"DS18B20": {"Temperature": 99}}', 1, True)
        await client.publish("dev/out", '{"out": 37.5}', 1, True)
        backend = create(here(free_port, interval_s=0.3))
        with pytest.raises(LinkError, match="a retained PV does not count"):
            await backend.open()
        await backend.close()
        backend = create(here(free_port, interval_s=3.0))
        await opened_by(client, asyncio.ensure_future(backend.open()), 21)
        assert await backend.read(["pv", "output"]) == {"pv": 21.0, "output": 37.5}
        await backend.close()


@pytest.mark.realtime
@pytest.mark.alone
async def test_samples_carry_the_time_of_arrival_and_silence_is_nan(broker, free_port):
    broker()
    await listening(free_port)
    clock = asyncio.get_running_loop().time
    async with aiomqtt.Client("127.0.0.1", free_port) as client:
        backend = create(here(free_port, interval_s=0.6))
        await opened_by(client, asyncio.ensure_future(backend.open()), 20)
        seen = []
        for pv in (21, 22):
            sent_s = clock()
            await client.publish("dev/sensor", json.dumps({"DS18B20": {"Temperature": pv}}), 1)
            await asyncio.sleep(0.2)
            values = await backend.read(["pv"])
            seen.append((values["pv"], backend.moment_s - sent_s))
        unchanged = (await backend.read(["pv"]))["pv"], backend.moment_s - clock()
        await asyncio.sleep(0.5)
        silent = (await backend.read(["pv"]))["pv"]
        await backend.close()
    assert [value for value, _ in seen] == [21.0, 22.0]
    assert all(0.0 <= max_lateness_s < 0.15 for _, max_lateness_s in seen)
    assert unchanged == (22.0, pytest.approx(0.0, abs=0.05))
    assert math.isnan(silent)


@pytest.mark.realtime
async def test_a_command_that_is_not_confirmed_is_an_error(broker, device, free_port):
    broker()
    await listening(free_port)
    device()
    async with opened(here(free_port, timeout_s=0.5)) as backend:
        with pytest.raises(DeviceRefusedError, match="was set to 150 on dev/out/set, but the device reports 100"):
            await backend.write({"output": 150.0})
        await backend.write({"auto": 1.0})
        with pytest.raises(DeviceRefusedError, match="was set to 10"):
            await backend.write({"output": 10.0})


@pytest.mark.realtime
async def test_the_last_will_of_the_device_ends_reading_and_its_return_mends_it(broker, device, free_port):
    broker()
    await listening(free_port)
    process = device()
    gone = []
    async with opened(here(free_port, availability={"topic": "dev/status"})) as backend:
        backend.watch(gone.append)
        process.kill()
        async with asyncio.timeout(PATIENCE_S):
            while not gone:  # noqa: ASYNC110 - the callback only appends
                await asyncio.sleep(0.05)
        with pytest.raises(LinkError, match="reports 'offline' on dev/status"):
            await backend.read(["pv"])
        device()
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with contextlib.suppress(DriverError):
                    await backend.read(["pv"])
                    break
                await asyncio.sleep(0.1)


@pytest.mark.realtime
async def test_our_own_will_is_published_when_we_are_killed_and_when_we_leave(broker, device, free_port):
    broker()
    await listening(free_port)
    device()
    options = here(free_port, will={"topic": "tuner/status"}, keep_alive_s=1.0)
    code = (
        "import asyncio, json, sys; from autotuner_drivers.mqtt import create\n"
        "async def main():\n"
        "    await create(json.loads(sys.argv[1])).open(); print('open', flush=True); await asyncio.sleep(60)\n"
        "asyncio.run(main())"
    )
    async with aiomqtt.Client("127.0.0.1", free_port) as client, asyncio.timeout(PATIENCE_S):
        await client.subscribe("tuner/status", 1)
        heard = client.messages
        other = subprocess.Popen([sys.executable, "-c", code, json.dumps(options)], stdout=subprocess.PIPE)  # noqa: ASYNC220
        try:
            assert (await anext(heard)).payload == b"online"
        finally:
            other.send_signal(signal.SIGKILL)
            other.wait()
            other.stdout.close()
        assert (await anext(heard)).payload == b"offline"
        async with opened(options):
            assert (await anext(heard)).payload == b"online"
        assert (await anext(heard)).payload == b"offline"


@pytest.mark.realtime
async def test_a_broker_that_restarts_is_a_lost_link_and_found_again(broker, device, free_port):
    first = broker()
    await listening(free_port)
    device()
    async with opened(here(free_port)) as backend:
        first.kill()
        first.wait()
        with pytest.raises(LinkError):
            await read_on(backend)
        broker()
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with contextlib.suppress(DriverError):
                    await backend.read(["pv"])
                    break
                await asyncio.sleep(0.2)


@pytest.mark.realtime
async def test_login_and_tls(broker, free_port, tmp_path, certificate):
    words = tmp_path / "words"
    maker = shutil.which("mosquitto_passwd") or pytest.skip("mosquitto_passwd is not installed")
    words.touch(mode=0o600)
    subprocess.run([maker, "-b", str(words), "tuner", "sesame"], check=True)  # noqa: ASYNC221
    broker(
        f"listener {free_port} 127.0.0.1", "allow_anonymous false", f"password_file {words}",
        f"user {__import__('getpass').getuser()}", f"certfile {certificate[0]}", f"keyfile {certificate[1]}",
    )  # fmt: skip
    await listening(free_port)
    word = tmp_path / "word"
    word.write_text("sesame\n", encoding="utf-8")
    secure = {"tls": True, "ca_file": str(certificate[0]), "user": "tuner", "password_file": str(word)}
    with pytest.raises(LinkError, match="nothing was reported"):  # let in, but there is no device
        await create(here(free_port, interval_s=0.2, host="localhost") | secure).open()
    word.write_text("barley\n", encoding="utf-8")
    with pytest.raises(LinkError, match="refused the login") as refusal:
        await create(here(free_port, host="localhost") | secure).open()
    assert "barley" not in str(refusal.value)
