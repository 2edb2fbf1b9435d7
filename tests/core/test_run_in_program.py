"""`autotuner.run` on a plant of the caller's own program: right gains, and the output restored on every end."""

import asyncio
import signal
import subprocess
import sys

import pytest

import autotuner
from autotuner.core.design import DesignSpec
from autotuner.errors import AutotunerError, InputError

PLANT = {"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}, "output0": 40.0, "pv0": 80.0, "noise": 0.05}
QUICK = {"sample_time_s": 0.1, "relay": {"amplitude": 10.0}}


class Rig:
    """A plant of discrete first order with dead time that moves with each read."""

    def __init__(self, fail_after=10**9):
        self.output, self.pv, self.past = 40.0, 80.0, [40.0] * 8
        self.reads, self.fail_after = 0, fail_after

    def read(self):
        self.reads += 1
        if self.reads > self.fail_after:
            raise ValueError("the sensor is gone")
        self.past.append(self.output)
        self.pv += 0.05 * (2.0 * self.past.pop(0) - self.pv)
        return self.pv

    def write(self, output):
        self.output = output

    async def write_later(self, output):
        await asyncio.sleep(0.0)
        self.output = output


def test_a_simulated_plant_is_tuned_in_virtual_time(tmp_path):
    seen = []
    goal = DesignSpec(rule="simc_pi")
    result = autotuner.run(simulated=PLANT, structure="fopdt", goal=goal, progress=seen.append, **QUICK)
    assert result.done, result.verdict
    assert pytest.approx((2.0, 10.0, 1.5), rel=0.05) == (result.model.K, result.model.T, result.model.D)
    assert result.gains.Kp > 0.0
    assert len(result.recording) < len(seen)
    assert result.report(tmp_path / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert result.plot(tmp_path / "picture.png").axes
    assert len(repr(result)) < 400
    assert "Kp" in result._repr_html_()
    assert result.to_dict()["tuning"]["predicted"]["overshoot"] == result.design.predicted.overshoot


@pytest.mark.long  # tests/design/test_device_controller
@pytest.mark.usefixtures("without_diagnosis")
def test_gains_are_for_the_controller_that_will_hold_them():
    controller = {"form": "ideal", "set_point_weight": 1.0}
    result = autotuner.run(simulated=PLANT, structure="fopdt", controller=controller, **QUICK)
    assert (result.gains.b, result.gains.Tf) == (1.0, 0.0)
    assert result.design.overshoot < 0.13


@pytest.mark.realtime
@pytest.mark.parametrize("write", ["write", "write_later"])
def test_an_error_of_progress_ends_the_experiment_and_is_raised_after_the_restore(write):
    rig = Rig()

    def progress(_):
        if rig.output != 40.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        autotuner.run(
            rig.read,
            getattr(rig, write),
            output=40.0,
            sample_time_s=0.02,
            relay={"quiet_s": 0.5},
            progress=progress,
        )
    assert rig.output == 40.0


@pytest.mark.realtime
def test_an_exception_in_a_callable_is_a_verdict_and_the_output_is_restored():
    rig = Rig(fail_after=60)
    result = autotuner.run(rig.read, rig.write, output=40.0, sample_time_s=0.02, relay={"quiet_s": 0.5})
    assert not result.done
    assert rig.output == 40.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"read": None},
        {"write": 3},
        {"output": None},
        {"structure": "foo"},
        {"goal": "fast"},
        {"sample_time_s": 0.0},
        {"limits": {"outputs": (0, 1)}},
        {"relay": {"amplitud": 1.0}},
        {"process_action": "up"},
        {"controller": {"form": "foo"}},
        {"controller": {"form": "eurotherm"}},
        {"simulated": PLANT},
    ],
)
def test_a_wrong_argument_is_refused_before_anything_is_called(wrong):
    rig = Rig()
    with pytest.raises(AutotunerError) as refused:
        autotuner.run(**{"read": rig.read, "write": rig.write, "output": 40.0} | wrong)
    assert rig.reads == 0
    assert refused.value.remedy


def test_tune_is_deprecated_and_design_replaces_it():
    model = autotuner.Fopdt(2.0, 10.0, 1.5)
    with pytest.warns(DeprecationWarning, match=r"autotuner\.design"):
        old = autotuner.tune(model)
    assert autotuner.design(model).gains == old.gains
    with pytest.raises(InputError):
        autotuner.design(model, "fast")


SCRIPT = """
import threading, time
from pathlib import Path
import autotuner

print("started")
mark = Path("output")
work = threading.Thread(target=lambda: time.sleep(3600), daemon=True)
work.start()

def write(output):
    time.sleep(0.05)
    mark.write_text(str(output))

print(autotuner.run(lambda: 80.0, write, output=40.0, sample_time_s=0.02, relay={"quiet_s": 0.5, "hysteresis": 1.0}))
"""


def script(folder):
    """Start a program of a stranger: no guard around what it does, a thread of its own, a slow function."""
    file = folder / "rig.py"
    file.write_text(SCRIPT, encoding="utf-8")
    return subprocess.Popen([sys.executable, str(file)], cwd=folder, stdout=subprocess.PIPE, text=True)


@pytest.mark.realtime
def test_a_program_that_is_ended_in_the_middle_restores_its_output(tmp_path):
    """The PV never moves, so the relay waits at its first level until the program is ended."""
    mark = tmp_path / "output"
    with script(tmp_path) as program:
        while not mark.exists() or mark.read_text(encoding="utf-8") in ("", "40.0"):
            assert program.poll() is None
        program.terminate()
        told, _ = program.communicate()
    assert mark.read_text(encoding="utf-8") == "40.0"
    assert told == "started\n"
    assert program.returncode == 128 + signal.SIGTERM


@pytest.mark.realtime
def test_a_script_without_a_guard_is_run_once_and_its_computations_elsewhere(tmp_path):
    """A worker process that imported the script would start it again, and print once more."""
    file = tmp_path / "script.py"
    file.write_text(
        "import asyncio, os\n"
        "from autotuner.application.computing.compute_pool import Workers\n"
        "print('started', flush=True)\n"
        "async def main():\n"
        "    pool = Workers()\n"
        "    print(await pool.run(os.getpid) != os.getpid())\n"
        "    pool.close()\n"
        "asyncio.run(main())\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, check=False)
    assert (done.stdout.splitlines(), done.returncode) == (["started", "True"], 0), done.stderr
