"""A verification over a device that loses or damages single readings, in a program that stands still by itself."""

import asyncio
import copy
import math
from types import SimpleNamespace

import async_solipsism
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.gain_service import GainService
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.control.devices.plugins import make_backend
from autotuner.control.records.journal import Journal
from autotuner.control.verification import verify
from autotuner.errors import DeviceTimeoutError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from tests.control.conftest import Faulty, loop_table, nothing

pytestmark = pytest.mark.usefixtures("without_diagnosis")

OLD = {"kp": 1.0, "ti": 20.0, "td": 0.0}
SILENT = DeviceTimeoutError("the device did not answer", remedy="Check the link.")


def table():
    return loop_table({"gains": OLD, "auto": True, "seed": 4}, gains={"form": "ideal", "derivative_filter": 8.0})


@pytest.fixture(scope="module")
def tuned():
    """A tuning with gains; never changed, a test has a copy."""
    loop = table()
    made = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings(check=False), "fopdt"))

    async def main():
        await made.conduct(loop, make_backend("simulated", loop.device, "loops.x"), InPlace())

    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(main())
    assert made.succeeded
    return made


@pytest.fixture
def verified(tuned, tmp_path, virtual):
    """Return a function that applies and verifies the gains over a device that does what a script says."""

    def conduct(script):
        loop, tuning = table(), copy.copy(tuned)
        tuning.device_gains = dict(OLD)
        device = make_backend("simulated", loop.device, "loops.x")
        backend = Faulty(device, script)

        async def main():
            gain_service = GainService("TIC-101", loop, backend, Journal(tmp_path / "data", in_place=True))
            script.run = tuning
            run = await gain_service.use(tuning, InPlace())
            await device.open()
            return SimpleNamespace(run=run, held=await device.read([*OLD, SET_POINT, AUTO]), written=backend.written)

        return virtual(main())

    return conduct


class Once:
    """Damages one reading of all signals, in the phase that is wanted, or has it end without an answer."""

    def __init__(self, stepped, answer):
        self.stepped, self.answer, self.run, self.looks, self.done = stepped, answer, None, 0, False

    async def __call__(self, call, _number, names):
        run = self.run and self.run.verification
        if self.done or call != "read" or PV not in names or run is None or (run.band is not None) != self.stepped:
            return None
        self.looks += 1
        if self.looks != 5:
            return None
        self.done = True
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


DAMAGED = {
    "no answer": SILENT,
    "mode reads manual": {AUTO: 0.0},
    "mode reads no number": {AUTO: math.nan},
    "PV beyond its limits": {PV: 3276.7},
    "PV reads no number": {PV: math.nan},
    "output reads no number": {OUTPUT: math.nan},
    "output reads 6553.5": {OUTPUT: 6553.5},
    "set point reads 0": {SET_POINT: 0.0},
    "all of a message reads 0": {PV: 0.0, OUTPUT: 0.0, AUTO: 0.0, SET_POINT: 0.0},
}


@pytest.mark.parametrize("stepped", [False, True], ids=["at rest", "in the step"])
@pytest.mark.parametrize("fault", DAMAGED)
def test_one_damaged_reading_ends_no_verification(verified, fault, stepped):
    script = Once(stepped, DAMAGED[fault])
    seen = verified(script)
    assert script.done
    assert (seen.run.verdict.code, seen.run.rolled_back) == ("verified", False), seen.run.verdict
    assert (seen.held[SET_POINT], seen.held[AUTO]) == (80.0, 1.0)


def test_somebody_who_takes_the_loop_to_manual_ends_it(verified):
    async def script(call, _number, names):
        run = script.run and script.run.verification
        return {AUTO: 0.0} if call == "read" and PV in names and run is not None and run.samples else None

    script.run = None
    seen = verified(script)
    assert (seen.run.verdict.code, seen.run.rolled_back) == ("mode_changed", True)


def test_a_pv_that_stays_beyond_its_limits_ends_it(verified):
    async def script(call, _number, names):
        run = script.run and script.run.verification
        return {PV: 260.0} if call == "read" and PV in names and run is not None and run.samples else None

    script.run = None
    seen = verified(script)
    assert (seen.run.verdict.code, seen.run.rolled_back) == ("pv_limit", True)
    assert {name: seen.held[name] for name in OLD} == OLD


def stands_still(monkeypatch, name, seconds):
    """Have the program itself do nothing for so long, once, where it does arithmetic between two samples."""
    work, done = getattr(verify, name), []

    def slow(*args):
        if not done:
            done.append(True)
            asyncio.get_running_loop()._selector.clock.advance(seconds)
        return work(*args)

    monkeypatch.setattr(verify, name, slow)


@pytest.mark.parametrize("where", ["measure_quiet", "largest_noise"])
def test_own_arithmetic_before_the_step_is_not_charged_to_the_device(verified, monkeypatch, where):
    """`pv_timeout_s` is 2 s here: modules that are loaded late took as long on a busy machine."""
    stands_still(monkeypatch, where, 10.0)
    run = verified(nothing_of_it()).run
    assert run.verdict.code == "verified"


def test_own_arithmetic_in_the_step_is_told_as_that(verified, monkeypatch):
    """What the loop did meanwhile was not seen, so it is not verified; the verdict names who stood still."""
    stands_still(monkeypatch, "Verification", 10.0)
    run = verified(nothing_of_it()).run
    assert (run.verdict.code, run.rolled_back) == ("process_stalled", True)
    assert "stood still for 10" in run.verdict.message


def nothing_of_it():
    async def script(*call):
        await nothing(*call)

    return script
