"""Gains into devices on serial lines and back: Eurotherm's protocol, Modbus RTU, and the steps a template tells."""

import json
import subprocess
import sys

import pytest

from autotuner.application.gain_service import GainService
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.records.journal import Journal
from autotuner.core.design import PidGains

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals exist on POSIX only")

NEW = PidGains(1.7, 8.4, 1.3)


def desk_of(tmp_path, **loop):
    configuration = parse_configuration({"loops": {"A": {"sample_time_s": 0.1, **loop}}}, "test")
    table = configuration.loops["A"]
    return GainService("A", table, make_backend(table.driver, table.device, "loops.A"), Journal(tmp_path / "data"))


@pytest.mark.realtime
async def test_eurotherm_takes_a_band_with_its_decimals_and_gets_the_old_one_back(peer, tmp_path):
    port = tmp_path / "ttyPEER"
    peer("serial_peer.py", "--protocol", "eurotherm", "--link", port, "--plant", 2, 10, 1.5)
    gain_service = desk_of(
        tmp_path,
        driver="serial",
        gains={"form": "eurotherm", "pv_span": 200.0, "output_span": 100.0},
        device={"protocol": "eurotherm", "serial_port": str(port), "timeout_s": 0.5},
    )
    before = (await gain_service.read())["values"]
    applied = await gain_service.write(NEW)
    # Band = 100 %/(1.7 * 200/100) = 29.41 % of the display range, one decimal
    assert applied.now == pytest.approx({"kp": 29.4, "ti": 8.4, "td": 1.3})
    assert applied.held.gains.Kp == pytest.approx(50.0 / 29.4)
    assert (await gain_service.roll_back()).now == before


@pytest.fixture
def rtu(tmp_path):
    """Return the serial port of a simulated PLC in another process."""
    port = tmp_path / "ttyPLC"
    words = [sys.executable, "-m", "autotuner", "plc", "--rtu", str(port), "--gains", "0.7", "13.3", "0.1"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert json.loads(process.stdout.readline())["ready"]
    yield port
    process.terminate()
    process.wait()
    process.stdout.close()


@pytest.mark.realtime
async def test_modbus_rtu_takes_gains_and_gets_the_old_ones_back(rtu, tmp_path):
    addresses = {"kp": 10, "ti": 12, "td": 14}
    registers = {name: {"table": "holding", "address": at, "type": "float32"} for name, at in addresses.items()}
    plain = {"pv": {"table": "input", "address": 0}, "output": {"table": "holding", "address": 0}}
    gain_service = desk_of(
        tmp_path,
        driver="modbus",
        gains={"form": "ideal"},
        device={"transport": "rtu", "serial_port": str(rtu), "registers": plain | registers},
    )
    before = (await gain_service.read())["values"]
    applied = await gain_service.write(NEW)
    assert applied.now == pytest.approx({"kp": 1.7, "ti": 8.4, "td": 1.3})
    assert (await gain_service.roll_back()).now == before == pytest.approx({"kp": 0.7, "ti": 13.3, "td": 0.1})


def test_a_template_tells_the_decimals_of_its_commands():
    signals = {
        "pv": {"read": "PV?"},
        "output": {"write": "OUT {output:.1f}"},
        "kp": {"read": "P?", "write": "P {kp:.3f}"},
        "ti": {"read": "I?", "write": "I {ti}"},
    }
    board = make_backend("serial", {"protocol": "template", "serial_port": "x", "signals": signals}, "loops.A")
    assert [board.resolution(name, 1.0) for name in ("output", "kp", "ti")] == pytest.approx([0.1, 0.001, 0.0])
