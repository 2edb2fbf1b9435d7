"""Limits that a device cannot hold are refused before anything is connected, with the key and the remedy."""

import math

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.manager import Manager
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.devices.ranges import check_ranges
from autotuner.errors import ConfigurationError

REGISTERS = {
    "pv": {"table": "input", "address": 0, "type": "int16", "scale": 0.1},
    "output": {"table": "holding", "address": 0, "type": "uint16", "scale": 0.001},
}
"""PV -3276.8 to 3276.7, output 0 to 65.535."""


def configured(limits, device=None, driver="modbus"):
    device = {"host": "plc", "registers": REGISTERS} if device is None else device
    return parse_configuration({"loops": {"X": {"driver": driver, "limits": limits, "device": device}}}, "test")


def refusal(limits, **keys):
    loop = configured(limits, **keys).loop("X")
    with pytest.raises(ConfigurationError) as told:
        check_ranges(loop.experiment_settings().limits, make_backend(loop.driver, loop.device, "loops.X"), "loops.X")
    return told.value


@pytest.mark.parametrize(
    ("limits", "key", "value"),
    [
        ({"output": [0.0, 100.0]}, "loops.X.limits.output", 100.0),
        ({"output": [-1.0, 50.0]}, "loops.X.limits.output", -1.0),
        ({"output": [0.0, 50.0], "pv": [0.0, 5000.0]}, "loops.X.limits.pv", 5000.0),
    ],
)
def test_a_limit_outside_of_the_register_names_key_value_and_remedy(limits, key, value):
    error = refusal(limits)
    assert (error.field, error.value) == (key, value)
    assert "scale" in error.remedy
    assert "65.535" in error.message or "3276.7" in error.message


def test_a_heater_of_a_board_has_its_range(tmp_path):
    board = {"protocol": "tclab", "serial_port": str(tmp_path / "tty")}
    assert refusal({"output": [0.0, 120.0]}, device=board, driver="serial").field == "loops.X.limits.output"


def test_limits_within_and_devices_that_do_not_tell_pass():
    for driver, device in (
        ("modbus", None),
        ("simulated", {"plant": {"structure": "fopdt", "K": 2.0, "T": 9.0, "D": 1.0}}),
    ):
        loop = configured({"output": [0.0, 65.0]}, driver=driver, device=device).loop("X")
        backend = make_backend(loop.driver, loop.device, "loops.X")
        check_ranges(loop.experiment_settings().limits, backend, "loops.X")


def test_the_service_does_not_start_with_such_limits(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=r"limits\.output"):
        Manager(configured({"output": [0.0, 100.0]}), InPlace())


def test_a_tuning_is_refused_before_anything_is_opened(rig, virtual):
    one = rig()
    one.backend.limits = lambda name: (0.0, 65.535) if name == "output" else (-math.inf, math.inf)
    verdict = virtual(one.conduct())
    assert verdict.code == "limits_not_held"
    assert "limits.output 100" in verdict.message
    assert one.backend.counts["open"] == 0
