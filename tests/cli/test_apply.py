"""`autotuner apply`, `rollback`, `tune --apply`, `--verify`, and what `check` says of [gains]: as a user runs them."""

import getpass
import json
import socket
import subprocess
import sys

import pytest
from pyModbusTCP.client import ModbusClient

from autotuner.cli import main
from autotuner.service.archive.storage.database import Database
from autotuner.service.archive.storage.database_address import address_of
from tests.control.processes import PATIENCE_S, port_of_nobody

PLC = """
[service]
data_directory = "{folder}/data"
[loops.TIC]
limits = {{ output = [0.0, 100.0], pv = [0.0, 250.0] }}
driver = "modbus"
sample_time_s = 0.1
[loops.TIC.gains]
{gains}
[loops.TIC.device]
host = "127.0.0.1"
port = {port}
timeout_s = 0.5
[loops.TIC.device.registers]
pv = {{ table = "input", address = 0, scale = 0.1 }}
output = {{ table = "holding", address = 0, scale = 0.1 }}
set_point = {{ table = "holding", address = 1, scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""
SIEMENS = 'form = "siemens_pid_compact"\noutput_span = 100'


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def audit(folder):
    """Return what the audit of the data directory tells, the newest first: action, status, loop; of this user only."""
    database = Database(address_of(folder / "data", None))
    found = database.audit(100, actor=f"shell:{getpass.getuser()}")
    assert len(database.audit(100)) == len(found)
    database.close()
    return [(row["action"], row["status"], row["loop"]) for row in found]


@pytest.fixture
def config(tmp_path):
    """Return a function that writes a configuration."""

    def write(port=1, gains=SIEMENS):
        path = tmp_path / "loops.toml"
        path.write_text(PLC.format(folder=tmp_path, port=port, gains=gains), encoding="utf-8")
        return path

    return write


@pytest.fixture
def plc(shared):
    """A PLC that is not ours; its port and the port of its own account."""
    process = subprocess.Popen(
        [sys.executable, str(shared / "peers" / "plc_libmodbus.py"), "--tcp", "0", "--control", "0",
         "--plant", "2", "10", "1.5", "--own-pid", "0.7", "13.3", "0.1", "--duration", "60"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    ready = json.loads(process.stdout.readline())
    yield ready["tcp"], ready["control"]
    process.kill()
    process.wait()
    process.stdout.close()


def ask(port, command="get"):
    with socket.create_connection(("127.0.0.1", port), 5.0) as line, line.makefile() as answers:
        line.sendall(command.encode() + b"\n")
        return json.loads(answers.readline())


def words(port):
    """Return the gain registers as somebody else's client reads them."""
    client = ModbusClient("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        return client.read_holding_registers(10, 6)
    finally:
        client.close()


@pytest.mark.realtime
def test_gains_into_a_plc_that_is_not_ours_and_the_exact_old_words_back(capsys, config, plc, tmp_path):
    port, control = plc
    path, before = config(port), words(port)
    code, out, _ = run(capsys, "apply", "TIC", "--config", path, "--gains", "1.5,4,0.6", "--dry-run")
    assert (code, words(port)) == (0, before)
    assert "would be written" in out
    code, out, err = run(capsys, "apply", "TIC", "--config", path, "--gains", "1.5,4,0.6", "--json")
    assert code == 0, err
    assert json.loads(out)["now"]["values"] == pytest.approx({"kp": 1.5, "ti": 4.0, "td": 0.6})
    truth = ask(control)
    assert (truth["kp"], truth["ti"], truth["td"]) == pytest.approx((1.5, 4.0, 0.6))
    ask(control, "set kp 1.75")
    code, _, err = run(capsys, "rollback", "TIC", "--config", path)
    assert code == 1
    assert "kp: is 1.75 in the device, but was 1.5 when they were applied" in err
    code, out, _ = run(capsys, "rollback", "TIC", "--config", path, "--force")
    assert (code, words(port)) == (0, before)
    assert "restored" in out
    code, _, err = run(capsys, "rollback", "TIC", "--config", path)
    assert code == 1
    assert "no gains that were applied" in err
    assert audit(tmp_path) == [("autotuner rollback TIC", 200, "TIC"), ("autotuner apply TIC", 200, "TIC")]


@pytest.mark.realtime
def test_a_tuning_and_an_apply_exclude_each_other(capsys, config, plc, tmp_path):
    from autotuner.configuration import load_configuration
    from autotuner.control.records import device_lock

    path = config(plc[0])
    key = load_configuration(path).loops["TIC"].device_key
    lock = device_lock.acquire(tmp_path / "data" / "leases" / key)
    lock.mark("tuning-7")
    code, _, err = run(capsys, "apply", "TIC", "--config", path, "--gains", "1.5,4,0.6")
    lock.release()
    assert code == 1
    assert "is held by tuning tuning-7" in err
    assert ask(plc[1])["kp"] == pytest.approx(0.7)


@pytest.mark.realtime
def test_a_plc_that_is_not_there(capsys, config, tmp_path):
    with port_of_nobody() as port:
        code, _, err = run(capsys, "apply", "TIC", "--config", config(port), "--gains", "1.5,4")
    assert code == 1
    assert "refused the connection" in err
    assert audit(tmp_path) == [("autotuner apply TIC", 502, "TIC")]


def test_tune_applies_and_verifies_in_one_go(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, "tune", "--verify", "--no-check", "--structure", "fopdt", "--rule", "simc_pi")
    assert code == 0, err
    for text in ("gains written and read back", "overshoot", "predicted", "verified:"):
        assert text in out


WRONG_GAINS = [
    ('form = "teapot"', "loops.TIC.gains.form: is not a known PID form"),
    ('form = "siemens_pid_compact"', "loops.TIC.gains.output_span: is missing"),
    ('form = "eurotherm"\noutput_span = 100', "loops.TIC.gains.pv_span: is missing"),
    ('form = "ideal"\ngain = "pv"', "loops.TIC.gains.gain: names a signal that cannot be written"),
    ('form = "ideal"\nderivative = "td2"', "loops.TIC.gains.derivative: names a signal that cannot be read"),
    ('form = "ideal"\nintegral = "kp"', "loops.TIC.gains: names one signal twice"),
    ('form = "ideal"\npv_span = 0', "loops.TIC.gains.pv_span"),
    ("", "loops.TIC.gains.form: is missing"),
]


@pytest.mark.parametrize(("gains", "told"), WRONG_GAINS, ids=[told for _, told in WRONG_GAINS])
def test_a_wrong_table_of_gains_names_the_key(capsys, config, gains, told):
    code, _, err = run(capsys, "check", config(gains=gains))
    assert code == 2
    assert told in err


def test_a_right_table_of_gains_is_told(capsys, config):
    code, out, _ = run(capsys, "check", config())
    assert code == 0
    assert "gains as Siemens PID_Compact" in out


MODES = """
[loops.OVEN]
driver = "modbus"
limits = {{ output = [0.0, 100.0], pv = [0.0, 400.0] }}
gains = {{ form = "{form}", pv_span = 400.0, output_span = 100.0 }}
[loops.OVEN.device]
host = "10.0.0.9"
[loops.OVEN.device.registers]
pv = {{ table = "input", address = 1 }}
output = {{ table = "holding", address = 3 }}
auto = {{ table = "holding", address = 273{auto} }}
kp = {{ table = "holding", address = 6 }}
ti = {{ table = "holding", address = 8 }}
td = {{ table = "holding", address = 9 }}
"""


@pytest.mark.parametrize(
    ("form", "auto", "doubted"),
    [
        ("eurotherm", "", True),
        ("eurotherm", ", auto_value = 0, manual_value = 1", False),
        ("west", ", auto_value = [1, 2], manual_value = 0", True),
        ("siemens_pid_compact", ", auto_value = 3, manual_value = 4", False),
        ("siemens_pid_compact", ", auto_value = 4, manual_value = 3", True),
        ("esphome", "", False),
        ("ideal", "", False),
    ],
)
def test_modes_that_the_device_counts_the_other_way_round_are_doubted(capsys, tmp_path, form, auto, doubted):
    file = tmp_path / "loops.toml"
    file.write_text(MODES.format(form=form, auto=auto), encoding="utf-8")
    code, _, err = run(capsys, "check", file)
    assert code == 0, err
    assert ("Correct auto_value and manual_value" in err) is doubted


USAGE = [
    (["apply", "TIC", "--gains", "1,2,3,4"], "is not one to three numbers"),
    (["apply", "TIC", "--gains", "fast"], "is not one to three numbers"),
    (["apply", "TIC", "--gains=-1.5,4"], "must be reverse acting"),
    (["apply", "TIC", "--gains", "0"], "gains.Kp"),
    (["apply", "TIC", "--from", "absent.json"], "cannot be read"),
    (["apply", "TAC", "--gains", "1"], "Use one of TIC"),
    (["rollback", "TAC"], "Use one of TIC"),
]


@pytest.mark.parametrize(("arguments", "told"), USAGE, ids=[" ".join(arguments) for arguments, _ in USAGE])
def test_wrong_usage_is_told_before_anything_is_sent(capsys, config, arguments, told):
    code, _, err = run(capsys, *arguments, "--config", config())
    assert code == 2
    assert told in err


def test_a_result_of_another_loop_or_without_gains_is_refused(capsys, config, tmp_path):
    result = tmp_path / "result.json"
    for told, words_ in (({"loop": "TAC", "gains": {"Kp": 1.0}}, "of loop TAC"), ({"gains": None}, "has no gains")):
        result.write_text(json.dumps(told), encoding="utf-8")
        code, _, err = run(capsys, "apply", "TIC", "--config", config(), "--from", result)
        assert code == 2
        assert words_ in err


def test_a_simulated_loop_dies_with_the_program(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(capsys, "apply", "demo", "--gains", "1.5,4")
    assert code == 2
    assert "tune --apply" in err


def test_a_loop_without_gains_is_refused_before_its_tuning(capsys, tmp_path):
    path = tmp_path / "loops.toml"
    path.write_text(
        '[loops.A]\ndriver = "simulated"\nsample_time_s = 0.1\n[loops.A.device]\n'
        'plant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }\n',
        encoding="utf-8",
    )
    code, out, err = run(capsys, "tune", "--config", path, "--apply")
    assert (code, out) == (2, "")
    assert "loops.A.gains" in err
