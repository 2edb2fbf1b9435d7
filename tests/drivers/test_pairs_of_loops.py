"""Two loops on one device, over real lines: both heaters of a board, and a cascade in a PLC."""

import contextlib
import json
import subprocess
import sys

import pytest

from autotuner.cli import main
from autotuner.core.recording import Recording
from tests.control.processes import CONTROLLER_REGISTERS, PATIENCE_S, REGISTERS, spawn

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals exist on POSIX only"),
]

SPEED = 40.0
"""Seconds of the heaters per second: their lags of two minutes take three seconds."""
AMBIENT = 23.0
HEATER = """
[loops.T{channel}]
driver = "serial"
sample_time_s = 0.05
limits = {{ output = [0.0, 100.0], pv = [0.0, 100.0] }}
relay = {{ amplitude = 20.0, quiet_s = 2.5 }}
device = {{ protocol = "tclab", serial_port = "{port}", channel = {channel} }}
"""
CASCADE = f"""
[loops.FIC-7]
driver = "modbus"
sample_time_s = 0.04
limits = {{{{ output = [0.0, 100.0], pv = [0.0, 200.0] }}}}
gains = {{{{ form = "ideal", derivative_filter = 8.0, scan_s = 0.05 }}}}

[loops.FIC-7.device]
host = "127.0.0.1"
port = {{port}}

[loops.FIC-7.device.registers]
{REGISTERS}{CONTROLLER_REGISTERS}
[loops.TIC-7]
driver = "modbus"
sample_time_s = 0.1
limits = {{{{ output = [20.0, 140.0], pv = [0.0, 150.0] }}}}

[loops.TIC-7.device]
host = "127.0.0.1"
port = {{port}}

[loops.TIC-7.device.registers]
pv = {{{{ table = "input", address = 3, type = "int16", scale = 0.1 }}}}
output = {{{{ table = "holding", address = 1, type = "int16", scale = 0.1 }}}}
"""


@pytest.fixture
def stack():
    with contextlib.ExitStack() as running:
        yield running


def write_heaters(folder, port):
    """Write the configuration of both channels of a board."""
    heaters = [HEATER.format(channel=channel, port=port) for channel in (1, 2)]
    (folder / "loops.toml").write_text("".join(heaters))


def tune(folder, *words):
    """Return what a tuning printed, as JSON."""
    command = [sys.executable, "-m", "autotuner", "tune", *words, "--config", str(folder / "loops.toml"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=folder)
    assert done.returncode == 0, done.stdout[:2000] + done.stderr
    return json.loads(done.stdout)


def tuned_heater(folder, loop, other):
    return tune(folder, loop, "--also-record", other, "--recording", str(folder / f"{loop}.csv"))


@pytest.mark.long
def test_both_heaters_of_a_board_are_judged_together(stack, tmp_path, capsys):
    port = tmp_path / "ttyLAB"
    words = ["--both-heaters", "--output0", "0", "--pv0", str(AMBIENT), "--noise", "0.02", "--speed", str(SPEED)]
    board = spawn(stack, "plc", "--tclab", str(port), *words)
    assert json.loads(board.stdout.readline())["ready"]
    write_heaters(tmp_path, port)
    for loop, other, K in (("T1", "T2", 0.65), ("T2", "T1", 0.55)):
        assert tuned_heater(tmp_path, loop, other)["model"]["K"] == pytest.approx(K, rel=0.1)
    assert main(["interaction", str(tmp_path / "T1.csv"), str(tmp_path / "T2.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["relative_gain"] == pytest.approx(0.65 * 0.55 / (0.65 * 0.55 - 0.25**2), rel=0.1)
    assert found["stable"]


@pytest.mark.long
def test_a_board_that_is_not_ours_is_tuned_while_its_other_channel_is_read_along(peer, tmp_path):
    """The peer's second heater warms nothing: its sensor reads the room."""
    port = tmp_path / "ttyPEER"
    peer("serial_peer.py", "--protocol", "tclab", "--link", port, "--plant", 0.65, 130, 15, "--speed", SPEED,
         "--noise", 0.02, "--y0", AMBIENT)  # fmt: skip
    write_heaters(tmp_path, port)
    found = tuned_heater(tmp_path, "T1", "T2")
    assert found["model"]["K"] == pytest.approx(0.65, rel=0.1)
    other = Recording.from_csv(tmp_path / "T1.csv").extra["T2"]
    assert other == pytest.approx([AMBIENT] * len(other), abs=0.01)


@pytest.mark.long
def test_a_cascade_in_a_plc_is_tuned_by_one_command(stack, tmp_path):
    inner = ["--plant", "K=2", "T=1", "D=0.2", "--output0", "40", "--pv0", "80", "--noise", "0.05"]
    plc = spawn(stack, "plc", "--port", "0", *inner, "--outer", "1.0", "4.0", "0.4", "--outer-pv0", "60")
    (tmp_path / "loops.toml").write_text(CASCADE.format(port=json.loads(plc.stdout.readline())["port"]))
    found = tune(tmp_path, "FIC-7", "--cascade", "TIC-7")
    inner, outer = found["FIC-7"], found["TIC-7"]
    assert inner["model"]["K"] == pytest.approx(2.0, rel=0.1)
    assert inner["device_gains"]["kp"] == pytest.approx(inner["gains"]["Kp"], rel=1e-4)
    assert outer["model"]["K"] == pytest.approx(1.0, rel=0.1)
    assert outer["gains"]["Kp"] > 0.0
    assert outer["restored"]
