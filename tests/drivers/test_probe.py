"""First contact: hand-worked readings judged, devices probed in virtual time, and the command."""

import argparse
import json
import math

import pytest

from autotuner.errors import ConfigurationError, LinkError
from autotuner_drivers import modbus, simulated
from autotuner_drivers.testing.commands import probe_command as command
from autotuner_drivers.testing.commands import read_loop
from autotuner_drivers.testing.probe import Reading, judge, probe
from autotuner_sim.devices.loop_device import LoopDevice
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant


def readings(*pvs, took_s=0.02, every_s=0.1, **others):
    values = {"output": 40.0, "auto": 0.0} | others
    return [Reading(every_s * k, took_s, values | {"pv": pv}) for k, pv in enumerate(pvs)]


def test_hand_worked_report():
    report = judge(readings(20.0, 20.1, 20.1, 20.3, 20.2), (0.0, 100.0))
    assert (report.readings, report.failures) == (5, 0)
    assert (report.took_median_s, report.took_p95_s, report.took_max_s) == (0.02, 0.02, 0.02)
    assert (report.pv_low, report.pv_high) == (20.0, 20.3)
    # the PV changed at 0.1, 0.3 and 0.4 s: the median time between changes is 0.15 s
    assert report.fresh_every_s == pytest.approx(0.15)
    assert report.sample_time_s == pytest.approx(0.15)
    assert report.doubts == ()


def test_the_sample_time_leaves_a_margin_over_slow_readings():
    some_slow = [
        Reading(0.1 * k, 0.4 if k >= 94 else 0.02, {"pv": float(k), "output": 0.0, "auto": 0.0}) for k in range(100)
    ]
    assert judge(some_slow).took_p95_s == 0.4
    assert judge(some_slow).sample_time_s == pytest.approx(0.6)
    few_slow = [Reading(0.01 * k, 0.4 if k >= 95 else 0.02, {"pv": float(k)}) for k in range(100)]
    assert judge(few_slow).sample_time_s == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("made", "doubt"),
    [
        (readings(20.0, 20.0, 20.0), "the PV never changed"),
        (readings(math.nan, math.nan), "no reading of the PV was a number"),
        (readings(20.0, 150.0, 21.0), "the PV read 150, beyond its limits"),
        (readings(20.0, 21.0, 22.0, auto=1.0), "the device is in auto"),
        ([Reading(0.1 * k, 0.02, {"pv": float(k), "auto": 0.0}) for k in range(5)], "the output cannot be read back"),
        ([Reading(0.1 * k, 0.02, {"pv": float(k), "output": 0.0}) for k in range(5)], "the mode cannot be read"),
        ([*readings(1.0, 2.0, 3.0), Reading(0.3, 0.5, {}, "no answer")], "1 of 4 readings failed: no answer"),
    ],
)
def test_doubts(made, doubt):
    (found,) = judge(made, (0.0, 100.0)).doubts
    assert doubt in found


def test_a_device_that_never_answers_is_all_failures():
    report = judge([Reading(0.0, 0.5, {}, "no answer")] * 3)
    assert (report.failures, report.readings) == (3, 3)
    assert math.isnan(report.sample_time_s)
    assert report.to_dict()["sample_time_s"] is None
    json.dumps(report.to_dict(), allow_nan=False)


def test_a_plc_is_probed_and_not_moved(virtual, default_map):
    """Its PV is fresh every 0.05 s, its scan; nothing but reads arrives."""

    async def main():
        plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Noise(0.5, seed=1)])
        served = SimulatedPlc(LoopDevice(plant))
        async with serving_tcp(served, "plc", 1502):
            made = await probe(modbus.create({"host": "plc", "port": 1502, "registers": default_map}), 10.0)
        return judge(made), served.device

    report, device = virtual(main())
    assert report.failures == 0
    assert 0.05 <= report.fresh_every_s < 0.075
    assert report.values["output"] == 40.0
    assert (device.output, device.auto, device.beat) == (40.0, False, 0)
    assert report.doubts == ()


def test_a_probe_arms_no_watchdog(virtual, default_map):
    """A heartbeat is a write: the PLC would take over once the probe has ended."""
    beat = {"heartbeat": {"table": "holding", "address": 2, "type": "uint16"}}

    async def main():
        plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0)
        served = SimulatedPlc(LoopDevice(plant))
        beats = []
        served.device.take_beat = beats.append
        async with serving_tcp(served, "plc", 1502):
            await probe(modbus.create({"host": "plc", "port": 1502, "registers": default_map | beat}), 3.0)
        return beats

    assert virtual(main()) == []


def test_a_simulated_loop_is_fresh_with_every_reading(virtual):
    plant = {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}
    made = virtual(probe(simulated.create({"plant": plant, "noise": 0.1, "auto": True}), 1.0))
    report = judge(made)
    assert report.fresh_every_s == pytest.approx(0.01)
    assert report.doubts == ("the device is in auto: a tuning switches it to manual and back",)


def test_an_absent_device_is_an_error_and_nothing_stays_open(virtual, default_map):
    with pytest.raises(LinkError):
        virtual(probe(modbus.create({"host": "plc", "port": 1502, "registers": default_map}), 1.0))


FILE = """
[loops.A]
driver = "simulated"
limits = { output = [0.0, 50.0], pv = [0.0, 250.0] }
[loops.A.device]
plant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }
pv0 = 80.0
noise = 0.1
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "loops.toml"
    path.write_text(FILE, encoding="utf-8")
    return path


def run_command(capsys, *arguments):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    code = command.run(parser.parse_args([str(a) for a in arguments]))
    return code, *capsys.readouterr()


def test_a_loop_of_a_file(file):
    loop = read_loop(file, None)
    assert (loop.name, loop.driver, loop.output, loop.pv) == ("A", "simulated", (0.0, 50.0), (0.0, 250.0))


@pytest.mark.realtime
def test_the_command_reports_in_words_and_as_json(capsys, file):
    code, out, _ = run_command(capsys, "A", "--config", file, "--seconds", 0.2)
    assert code == 0
    assert "A by driver simulated" in out
    assert "sample time" in out
    code, out, _ = run_command(capsys, "--config", file, "--seconds", 0.1, "--json")
    result = json.loads(out)
    assert code == 0
    assert (result["loop"], result["failures"]) == ("A", 0)
    assert result["pv_low"] == pytest.approx(80.0, abs=1.0)


@pytest.mark.parametrize(
    ("change", "arguments", "words"),
    [
        (("", ""), ("B",), "loop: is not a loop of"),
        (('"simulated"', '"teapot"'), (), "driver: is not an installed driver (got 'teapot')"),
        (("K = 2.0", "K = 0.0"), (), "plant: fopdt.K must not be zero"),
        (("[0.0, 50.0]", "[50.0, 0.0]"), (), "loops.A.limits.output: must be two ascending numbers"),
        (("[loops.A]", "[loops.A"), (), "cannot be used"),
    ],
)
def test_the_command_says_what_is_wrong(capsys, file, change, arguments, words):
    file.write_text(FILE.replace(*change) if change[0] else FILE, encoding="utf-8")
    code, _, err = run_command(capsys, *arguments, "--config", file)
    assert code == 2
    assert words in err


@pytest.mark.realtime
def test_the_command_fails_when_nobody_answers(capsys, tmp_path):
    path = tmp_path / "loops.toml"
    path.write_text(
        '[loops.A]\ndriver = "modbus"\n[loops.A.device]\nhost = "127.0.0.1"\nport = 1\n'
        'registers.pv = {table = "input", address = 0}\nregisters.output = {table = "holding", address = 0}\n',
        encoding="utf-8",
    )
    code, _, err = run_command(capsys, "--config", path)
    assert code == 1
    assert "refused the connection" in err


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be used"):
        read_loop(tmp_path / "none.toml", None)
