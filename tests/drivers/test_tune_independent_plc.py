"""The main job against a PLC that is not ours: `autotuner tune` over Modbus TCP, judged by the PLC's own account."""

import json
import socket
import subprocess
import sys

import pytest

from tests.control.processes import PATIENCE_S, port_of_nobody

SPEED = 5.0
"""Plant seconds per real second: the plant is identified in real seconds, so its times come out divided by this."""

CONFIG = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.04
pv_unit = "degC"
[loops.TIC-101.limits]
output = [0.0, 100.0]
pv = [0.0, 200.0]
[loops.TIC-101.relay]
amplitude = 10.0
quiet_s = 2.0
[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 0.5
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""


SHORT = ("--structure", "fopdt", "--rule", "simc_pi")
"""What keeps the analysis short: the link and the PLC are judged here."""


def ask(port, command="get"):
    with socket.create_connection(("127.0.0.1", port), 5.0) as line:
        line.sendall(command.encode() + b"\n")
        return json.loads(line.makefile().readline())


def tune(tmp_path, port, *arguments):
    config = tmp_path / "loops.toml"
    config.write_text(CONFIG.format(port=port), encoding="utf-8")
    return subprocess.run(
        [sys.executable, "-m", "autotuner", "tune", "--config", str(config), "--json", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        cwd=tmp_path,
    )


def start(peer, *arguments):
    """Start the PLC with the plant K 2, T 10, D 1.5 and sensor noise."""
    return peer(
        "plc_libmodbus.py", "--tcp", 0, "--control", 0, "--plant", 2, 10, 1.5, "--noise", 0.05, "--seed", 1,
        "--scan", 0.01, "--speed", SPEED, *arguments,
    )  # fmt: skip


@pytest.mark.realtime
def test_a_cold_plc_that_is_not_ours_is_tuned_and_given_back(peer, tmp_path):
    plc = start(peer)
    before = ask(plc["control"])
    done = tune(tmp_path, plc["tcp"], *SHORT)
    after = ask(plc["control"])
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    assert result["model"]["K"] == pytest.approx(2.0, rel=0.05)
    assert result["model"]["T"] == pytest.approx(10.0 / SPEED, rel=0.05)
    assert result["model"]["D"] == pytest.approx(1.5 / SPEED, rel=0.15)  # the scan and the link add up to 0.02 s
    assert result["gains"]["Kp"] > 0.0
    assert (after["auto"], after["u_cmd"]) == (before["auto"], before["u_cmd"])


@pytest.mark.realtime
def test_a_plc_in_auto_is_taken_over_and_goes_back_to_auto(peer, tmp_path):
    """Judged by K/T and D, which the relay shows sharply: K alone hangs on the exact moments of its switches."""
    rest = ("--auto", "--u0", 15, "--ubias", 15, "--y0", 50, "--sp", 50, "--own-pid", 0.5, 10.0, 0.0)
    plc = start(peer, *rest)
    done = tune(tmp_path, plc["tcp"], *SHORT)
    after = ask(plc["control"])
    assert done.returncode == 0, done.stdout + done.stderr
    model = json.loads(done.stdout)["model"]
    assert model["K"] / model["T"] == pytest.approx(0.2 * SPEED, rel=0.1)
    assert model["D"] == pytest.approx(1.5 / SPEED, rel=0.15)
    assert after["auto"] == 1.0
    assert (after["kp"], after["ti"]) == (0.5, 10.0)


@pytest.mark.realtime
def test_a_plc_that_is_not_there_is_a_verdict(tmp_path):
    with port_of_nobody() as port:
        done = tune(tmp_path, port)
    assert done.returncode == 1
    assert json.loads(done.stdout)["verdict"]["code"] == "device_unreachable"
