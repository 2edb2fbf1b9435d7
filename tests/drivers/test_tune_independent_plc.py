"""The main job against a PLC that is not ours: `autotuner tune` over Modbus TCP, judged by the PLC's own account."""

import json
import socket
import subprocess
import sys

import pytest

SPEED = 10.0
"""Plant seconds per real second: the plant is identified in real seconds, so its times come out divided by this."""

CONFIG = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.02
pv_unit = "degC"
[loops.TIC-101.limits]
output = [0.0, 100.0]
pv = [0.0, 200.0]
[loops.TIC-101.relay]
amplitude = 10.0
quiet_s = 1.0
[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 0.5
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""


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
        timeout=120.0,
        check=False,
        cwd=tmp_path,
    )


@pytest.mark.realtime
@pytest.mark.parametrize(
    "start", [("--u0", 0), ("--auto", "--sp", 50.0, "--own-pid", 1.0, 2.0, 0.0)], ids=["cold", "auto"]
)
def test_a_plc_that_is_not_ours_is_tuned_and_given_back(peer, tmp_path, start):
    plc = peer(
        "plc_libmodbus.py", "--tcp", 0, "--control", 0, "--plant", 2, 10, 1.5, "--noise", 0.05, "--seed", 1,
        "--scan", 0.01, "--speed", SPEED, *start,
    )  # fmt: skip
    if "--auto" in start:
        wait_until_settled(plc["control"])
    before = ask(plc["control"])
    done = tune(tmp_path, plc["tcp"])
    after = ask(plc["control"])
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    assert result["model"]["K"] == pytest.approx(2.0, rel=0.05)
    assert result["model"]["T"] == pytest.approx(10.0 / SPEED, rel=0.05)
    assert result["model"]["D"] == pytest.approx(1.5 / SPEED, rel=0.15)  # the scan and the link add up to 0.02 s
    assert result["gains"]["Kp"] > 0.0
    assert after["auto"] == before["auto"]
    if not before["auto"]:
        assert after["u_cmd"] == before["u_cmd"]


def wait_until_settled(control):
    """Let the PLC's own controller bring the plant to its set point."""
    ticker = socket.socket()
    ticker.settimeout(0.5)
    for _ in range(40):
        if abs(ask(control)["y_true"] - 50.0) < 0.05:
            break
        with pytest.raises(OSError):  # noqa: PT011 - a bounded pause without touching a clock
            ticker.connect(("127.0.0.1", 9))
    ticker.close()


@pytest.mark.realtime
def test_a_plc_that_is_not_there_is_a_verdict(tmp_path, unused_tcp_port):
    done = tune(tmp_path, unused_tcp_port)
    assert done.returncode == 1
    assert json.loads(done.stdout)["verdict"]["code"] == "device_unreachable"
