"""`autotuner probe ADDRESS`: what answers there, without a write, and a file of loops that `check` accepts."""

import argparse
import contextlib
import json
import shutil
import subprocess
import sys
import threading
import tomllib

import pytest
from pyModbusTCP.server import DataBank, DataHandler, ModbusServer

from autotuner.cli import main
from autotuner.errors import InputError
from autotuner_drivers.testing import discovery, searches
from autotuner_drivers.testing.commands import Loop, probe_command
from autotuner_drivers.testing.discovery import Found, Place, as_toml
from autotuner_drivers.testing.searches import numbers_in, search_named


class Alive(DataBank):
    """Input register 3 is a noisy measurement, register 5 a counter; coils and discrete inputs are none."""

    reads = 0
    noise = (300, 304, 299, 303, 298, 301, 305, 302)

    def get_input_registers(self, address, number=1, srv_info=None):
        words = super().get_input_registers(address, number, srv_info)
        self.reads += 1
        alive = {3: self.noise[self.reads % 8], 5: self.reads}
        return words and [alive.get(address + k, word) for k, word in enumerate(words)]


class ReadOnly(DataHandler):
    writes = 0

    def write_h_regs(self, *_):
        self.writes += 1
        return super().write_h_regs(*_)


@pytest.fixture
def device(free_port, monkeypatch):
    monkeypatch.setattr(discovery, "LOOK_S", 0.01)
    before = set(threading.enumerate())
    bank = Alive(coils_size=0, d_inputs_size=0, h_regs_size=7, i_regs_size=14)
    handler = ReadOnly(bank)
    server = ModbusServer("127.0.0.1", free_port, no_block=True, data_hdl=handler)
    server.start()
    yield handler
    server.stop()
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)


def probed(*words):
    parser = argparse.ArgumentParser()
    probe_command.configure(parser)
    return probe_command.run(parser.parse_args([*map(str, words), "--seconds", "0.5"]))


def signals_of(file):
    """Return the driver and the signals of the file, which `check` accepts."""
    loop = tomllib.loads(file.read_text())["loops"]["new"]
    assert main(["check", str(file)]) == 0
    return loop["driver"], next((v for v in loop["device"].values() if isinstance(v, dict)), None)


@pytest.mark.parametrize(
    ("values", "plausible", "resolution"),
    [
        ((20.0, 20.1, 19.9, 20.0), True, 0.1),
        ((20.0, 20.1, 20.3, 20.35), True, 0.05),  # a ramp with noise
        ((20.0, 20.0, 20.0), False, 0.0),
        ((7.0, 8.0, 9.0, 10.0), False, 1.0),  # a counter
        ((1000.0, 1001.0, 1002.0), False, 1.0),
        ((0.0, 1.0, 0.0), False, 1.0),  # a flag, or a heartbeat
    ],
)
def test_what_a_measurement_looks_like(values, plausible, resolution):
    found = Found(Place("x", {}), values)
    assert found.plausible is plausible
    assert found.resolution == pytest.approx(resolution)


def test_the_noise_of_alternating_values():
    # steps of 0.2: 1.4826 * 0.2 / sqrt(2)
    assert Found(Place("x", {}), (1.0, 1.2, 1.0, 1.2)).noise == pytest.approx(0.20967, abs=1e-4)


def test_toml_and_payloads():
    assert as_toml({"a": "x", "b": {"c": 1, "d": True}}) == '{ a = "x", b = { c = 1, d = true } }'
    assert numbers_in(b'{"t": {"in": 21.5, "on": true}, "l": [1, "a"]}') == [("t.in", 21.5), ("l.0", 1.0)]
    assert (numbers_in(b"21.5"), numbers_in(b"heat"), numbers_in(b"\xff")) == ([("", 21.5)], [], [])


def test_a_probe_leaves_out_what_a_driver_writes_by_itself():
    device = {"host": "h", "will": {"topic": "t"}, "registers": {"pv": {}, "heartbeat": {}}}
    assert Loop("a", "modbus", device).read_only().device == {"host": "h", "registers": {"pv": {}}}


@pytest.mark.realtime
def test_registers_that_answer_and_a_file_that_is_accepted(device, free_port, tmp_path, capsys):
    file = tmp_path / "new.toml"
    assert probed(f"modbus://127.0.0.1:{free_port}", "--toml", file) == 0
    out = capsys.readouterr().out
    assert "21 places can be read" in out
    assert [line.split()[1] for line in out.splitlines() if "PV?" in line] == ["3"]
    assert [line.split()[1] for line in out.splitlines() if " changes" in line] == ["5"]
    assert "readable: input 0 to 13" in out
    assert "readable: holding 0 to 6" in out
    assert "units that answer: 1, 255, 0, 2, 3" in out
    assert device.writes == 0
    driver, registers = signals_of(file)
    assert driver == "modbus"
    assert registers == {"pv": {"table": "input", "address": 3}, "output": {"table": "holding", "address": 0}}
    assert probed(f"modbus://127.0.0.1:{free_port}", "--toml", file) == 2


@pytest.mark.realtime
def test_a_loop_is_probed_without_its_heartbeat(device, free_port, tmp_path, capsys):
    file = tmp_path / "loops.toml"
    file.write_text(
        f'[loops.a]\ndriver = "modbus"\n[loops.a.device]\nhost = "127.0.0.1"\nport = {free_port}\n'
        'registers.pv = { table = "input", address = 3 }\nregisters.output = { table = "holding", address = 0 }\n'
        'registers.heartbeat = { table = "holding", address = 2, type = "uint16" }\n',
        encoding="utf-8",
    )
    assert probed("a", "--config", file) == 0
    assert "noise" in capsys.readouterr().out
    assert device.writes == 0


@pytest.mark.realtime
def test_nodes_that_answer(node_peer, free_port, tmp_path, capsys):
    peer = node_peer("opcua_plc.js", "node-opcua", free_port, 2, 2, 0.3)
    file = tmp_path / "new.toml"
    assert probed(peer["endpoint"], "--toml", file) == 0
    assert signals_of(file) == ("opcua", {"pv": {"node": "ns=1;s=PV"}, "output": {"node": "ns=1;s=OUT"}})
    assert "PV  ns=1;s=PV" in capsys.readouterr().out


@pytest.fixture
def process(peers):
    """Return a function that starts a peer and waits for its line; skips without its library."""
    running = contextlib.ExitStack()

    def start(script, *words, library=None):
        if library is not None:
            pytest.importorskip(library)
        command = [sys.executable, str(peers / script), *map(str, words)]
        begun = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        running.callback(begun.stdout.close)
        running.callback(begun.wait)
        running.callback(begun.kill)
        if not any(line.startswith("{") for line in begun.stdout):
            pytest.skip(f"{script} does not start here")

    with running:
        yield start


@pytest.mark.realtime
def test_data_blocks_that_answer(process, free_port, tmp_path, capsys):
    process("s7_plc.py", free_port, 2, 2, 0.3, library="snap7")
    file = tmp_path / "new.toml"
    assert probed(f"s7://127.0.0.1:{free_port}", "--toml", file) == 0
    assert "DB10 (64 bytes and more)" in capsys.readouterr().out
    driver, variables = signals_of(file)
    assert (driver, set(variables)) == ("s7", {"pv", "output"})


@pytest.mark.realtime
def test_channels_that_are_named(process, free_port, tmp_path, capsys):
    pytest.importorskip("caproto")
    process("epics_ioc.py", free_port, 2, 2, 0.3)
    file = tmp_path / "new.toml"
    assert probed(f"epics://127.0.0.1:{free_port}/TIC:PV,TIC:OUT", "--toml", file) == 0
    assert "0 to 100" in capsys.readouterr().out
    assert signals_of(file) == ("epics", {"pv": {"name": "TIC:PV"}, "output": {"name": "TIC:OUT"}})
    assert probed(f"epics://127.0.0.1:{free_port}") == 2


@pytest.mark.realtime
def test_tags_that_are_named(process, free_port, tmp_path):
    pytest.importorskip("pylogix")
    process("ethernetip_plc.py", free_port, 2, 2, 0.3)
    file = tmp_path / "new.toml"
    assert probed(f"ethernetip://127.0.0.1:{free_port}/0/PV,OUT", "--toml", file) == 0
    assert signals_of(file) == ("ethernetip", {"pv": {"tag": "PV"}, "output": {"tag": "OUT"}})


@pytest.fixture
def broker(free_port):
    """A broker on the free port; skips without mosquitto."""
    mosquitto = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/opt/homebrew/sbin") or shutil.which(
        "mosquitto"
    )
    if mosquitto is None:
        pytest.skip("mosquitto is not installed")
    with subprocess.Popen([mosquitto, "-p", str(free_port)], stderr=subprocess.PIPE, text=True) as running:
        assert any("running" in line for line in running.stderr)
        yield free_port
        running.kill()


@pytest.mark.realtime
def test_topics_that_arrive(broker, process, tmp_path):
    pytest.importorskip("aiomqtt")
    process("mqtt_device.py", broker, 2, 2, 0.3)
    file = tmp_path / "new.toml"
    assert probed(f"mqtt://127.0.0.1:{broker}/dev/#", "--toml", file) == 0
    driver, topics = signals_of(file)
    assert (driver, topics["pv"]["topic"], topics["pv"]["json"]) == ("mqtt", "dev/sensor", "DS18B20.Temperature")


@pytest.mark.realtime
def test_a_board_that_answers_at_a_port(peer, tmp_path, capsys):
    port, file = tmp_path / "ttyPEER", tmp_path / "new.toml"
    peer("serial_peer.py", "--protocol", "tclab", "--link", port, "--plant", 2, 1, 0.1)
    assert probed(f"serial://{port}", "--toml", file, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["driver"], tomllib.loads(answer["toml"])["loops"]["new"]["device"]["protocol"]) == (
        "serial",
        "tclab",
    )
    assert main(["check", str(file)]) == 0


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("address", "code"),
    [
        ("modbus://127.0.0.1:1", 1), ("opc.tcp://127.0.0.1:1", 1), ("mqtt://127.0.0.1:1", 1), ("s7://127.0.0.1:1", 1),
        ("epics://127.0.0.1:1/A,B", 1), ("ethernetip://127.0.0.1:1/0/A", 1), ("serial:///dev/no-such-port", 1),
        ("ftp://a", 2), ("modbus://", 2),
    ],
)  # fmt: skip
def test_nothing_there(address, code, capsys, monkeypatch):
    monkeypatch.setattr(searches, "TIMEOUT_S", 0.5)
    assert probed(address) == code
    assert capsys.readouterr().err.startswith("autotuner: ")


def test_an_address_names_its_remedy():
    with pytest.raises(InputError, match=r"opc\.tcp://HOST"):
        search_named("http://plc")
