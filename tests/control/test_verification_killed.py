"""A verification killed at every one of its writes: the next start gives gains, set point, mode and output back."""

import asyncio
import copy
import os
from types import SimpleNamespace

import async_solipsism
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.gain_service import GainService
from autotuner.application.manager import Manager
from autotuner.application.recovery import recover_first
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.records import device_lock
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Kind
from autotuner.errors import DeviceRefusedError, LinkError, LoopBusyError, StorageError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from tests.control.conftest import loop_table, nothing
from tests.control.killed import Device, killed, recover_alone

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="a program is killed in a process of its own")

OLD = {"kp": 1.0, "ti": 20.0, "td": 0.0}
AT_REST = {SET_POINT: 80.0, OUTPUT: 40.0, AUTO: 0.0}
GAINS = {"form": "ideal", "derivative_filter": 8.0}
MANUAL_WRITES = ["kp", "ti", "td", SET_POINT, AUTO, SET_POINT]
"""Of a verification in manual, up to its step."""
BACK = ["kp", "ti", "td", SET_POINT, AUTO, OUTPUT]


SAFE = 25.0
LIMITS = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "safe_output": SAFE}


def table(*, auto=False, **keys):
    return loop_table({"gains": OLD, "auto": auto}, gains=GAINS, **keys)


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
def scene(tuned, tmp_path, virtual):
    """Return a function that has a verification killed, and gives what is there afterwards."""

    def make(die, *, auto=False, wrong=False, apart=False, trip=False):
        """Kill a verification where `die` says.

        `wrong` has its model wrong, `apart` its gains applied before; with `trip` the PV leaves its limits in the step.
        """
        loop = table(auto=auto, **({"limits": LIMITS} if trip else {}))
        device = Device(make_backend("simulated", loop.device, "loops.x"), die)
        if trip:
            device.script = tripping(device)
        journal = Journal(tmp_path / "data", in_place=True)
        tuning = copy.copy(tuned)
        tuning.analysis = copy.deepcopy(tuned.analysis)
        if wrong:
            object.__setattr__(tuning.analysis.identification.model, "K", 1.0)
        tuning.device_gains = dict(OLD)

        async def main():
            own = journal.begin(tuning.head(loop.device_key))
            await own.end(tuning.verdict)
            gain_service = GainService("TIC-101", loop, device, journal)
            if apart:
                await gain_service.apply(tuning, tuning.analysis.gains.gains)
                device.written.clear()
                await gain_service.verify(tuning, InPlace())
            else:
                await gain_service.use(tuning, InPlace())

        was_killed = killed(device, main)
        device.reports_to = None
        found = SimpleNamespace(loop=loop, device=device, journal=journal, tuning=tuning, killed=was_killed)
        found.new = {"kp": tuning.analysis.gains.gains.Kp, "ti": tuning.analysis.gains.gains.Ti}
        return found

    return make


def before(number):
    """Die before the write of that number."""
    return lambda device, call, _names, done: call == "write" and not done and len(device.written) == number


def behind(number):
    """Die behind it."""
    return lambda device, call, _names, done: call == "write" and done and len(device.written) == number + 1


def in_the_step(device, call, _names, _done):
    """Die at a sample of the step."""
    return call == "read" and len(device.written) == len(MANUAL_WRITES) and device.counts["read"] % 97 == 0


def tripping(device):
    """A PV that is beyond its limit from the first sample of the step on."""

    async def script(call, number, names):
        await device._alive(call, number, names)
        stepped = [next(iter(values)) for values in device.written].count(SET_POINT) == 2
        return {PV: 260.0} if call == "read" and PV in names and stepped else None

    return script


def managed(one):
    """A manager over the device, as the next start has it."""
    raw = one.loop.model_dump(exclude_none=True)
    values = {"service": {"data_directory": str(one.journal.folder)}, "loops": {"TIC-101": raw}}
    manager = Manager(parse_configuration(values, "test"), InPlace(), lambda: "T2")
    manager._furnish("TIC-101", one.loop, one.device)
    return manager


async def held(one):
    await one.device.inner.open()
    return await one.device.inner.read([*OLD, *AT_REST])


def started_again(one, virtual, *, dead_s=0.0, change=None, wait_s=100.0):
    """What the next start shows, and what the device holds then."""

    async def main():
        if change:
            await one.device.inner.open()
            await one.device.inner.write(change)
        one.device.dead_until_s = dead_s
        one.device.written.clear()
        manager = managed(one)
        manager.open()
        busy = False
        try:
            manager.must_be_free("TIC-101")
        except LoopBusyError as error:
            busy = error.tuning_id
        await asyncio.sleep(wait_s)
        seen = await held(one)
        manager.must_be_free("TIC-101")
        await manager.close()
        return SimpleNamespace(seen=seen, tuning=manager.tunings.get("T1"), busy=busy, reported=manager.recovered_loops)

    return virtual(main())


def stands(seen, wanted):
    return {name: seen[name] for name in wanted} == wanted


@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
@pytest.mark.parametrize("number", range(len(MANUAL_WRITES + BACK)), ids=lambda n: f"{n}-{(MANUAL_WRITES + BACK)[n]}")
def test_killed_at_a_write_of_a_step_that_fails_everything_is_back(scene, virtual, number, moment):
    """Found in manual: gains, set point and mode written, the step made, all of it taken back."""
    one = scene(moment(number), wrong=True)
    assert one.killed
    assert [next(iter(values)) for values in one.device.written] == (MANUAL_WRITES + BACK)[: len(one.device.written)]
    (kept,) = one.journal.interrupted()
    assert (kept.kind, kept.tuning, kept.proved) == (Kind.VERIFICATION, "T1", False)
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert stands(after.seen, AT_REST)
    assert after.busy == "T1"
    assert after.tuning.verification.verdict.code == "interrupted"
    assert after.tuning.verdict == one.tuning.verdict
    assert [(one.kind, one.id, one.done) for one in after.reported] == [(Kind.VERIFICATION, "T1", True)]
    assert one.journal.interrupted() == []


@pytest.mark.parametrize("number", [6, 7, 8])
@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
def test_killed_behind_a_step_that_passed_the_gains_stay(scene, virtual, number, moment):
    one = scene(moment(number))
    assert one.killed
    assert {name: value for v in one.device.written[:3] for name, value in v.items()}["kp"] == one.new["kp"]
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in one.new} == one.new
    assert stands(after.seen, AT_REST)
    assert after.tuning.verification.verdict.code == "verified"


def test_killed_in_the_step_everything_is_back(scene, virtual):
    one = scene(in_the_step)
    assert one.killed
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert stands(after.seen, AT_REST)
    assert [next(iter(values)) for values in one.device.written] == BACK
    assert "the old gains are restored" in after.tuning.verification.verdict.message
    assert after.tuning.verification.rolled_back


AUTO_WRITES = ["kp", "ti", "td", SET_POINT, "kp", "ti", "td", SET_POINT]


@pytest.mark.parametrize("number", [2, 3, 5, 7])
@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
def test_found_in_auto_it_stays_there(scene, virtual, number, moment):
    one = scene(moment(number), auto=True, wrong=True)
    assert one.killed
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert (after.seen[SET_POINT], after.seen[AUTO]) == (80.0, 1.0)
    assert AUTO not in {name for values in one.device.written for name in values}


@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
@pytest.mark.parametrize("number", range(len(MANUAL_WRITES), len(MANUAL_WRITES + BACK)))
def test_killed_on_the_way_to_the_safe_output_it_ends_there(scene, virtual, number, moment):
    """Stopped by a limit of the PV: the declared safe output is where it was going."""
    one = scene(moment(number), trip=True)
    assert one.killed
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert stands(after.seen, AT_REST | {OUTPUT: SAFE})


def test_gains_that_were_applied_before_go_back_too(scene, virtual):
    """As an abort of that verification has them back."""
    one = scene(lambda _device, call, names, done: done and call == "write" and names == {AUTO}, apart=True)
    assert one.killed
    after = started_again(one, virtual)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert stands(after.seen, AT_REST)


def test_gains_that_somebody_has_set_since_are_left(scene, virtual):
    one = scene(in_the_step)
    after = started_again(one, virtual, change={"kp": 0.77})
    assert after.seen["kp"] == 0.77
    assert stands(after.seen, AT_REST)
    assert "kp" in after.tuning.verification.verdict.message
    assert not after.tuning.verification.rolled_back
    assert one.journal.interrupted() == []


def test_a_set_point_that_somebody_has_set_since_is_left_with_its_mode(scene, virtual):
    one = scene(in_the_step)
    after = started_again(one, virtual, change={SET_POINT: 71.0})
    assert (after.seen[SET_POINT], after.seen[AUTO]) == (71.0, 1.0)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert "71" in after.tuning.verification.verdict.message


def test_a_mode_that_somebody_has_set_since_is_left_with_its_output(scene, virtual):
    one = scene(in_the_step)
    after = started_again(one, virtual, change={AUTO: 0.0, OUTPUT: 12.0})
    assert (after.seen[SET_POINT], after.seen[OUTPUT], after.seen[AUTO]) == (80.0, 12.0, 0.0)
    assert {name: after.seen[name] for name in OLD} == OLD


def test_an_output_that_somebody_has_set_in_the_middle_of_the_way_back_is_left(scene, virtual):
    one = scene(before(len(MANUAL_WRITES + BACK) - 1), wrong=True)
    after = started_again(one, virtual, change={OUTPUT: 12.0})
    assert (after.seen[OUTPUT], after.seen[AUTO]) == (12.0, 0.0)
    assert "12" in after.tuning.verification.verdict.message


def test_over_a_dead_link_it_is_tried_until_it_is_back(scene, virtual):
    one = scene(in_the_step)
    after = started_again(one, virtual, dead_s=60.0, wait_s=200.0)
    assert {name: after.seen[name] for name in OLD} == OLD
    assert stands(after.seen, AT_REST)


def test_a_link_that_stays_dead_is_tried_again_until_it_is_back_and_no_tuning_starts_before(scene, virtual):
    """Nobody has to ask for it; whoever asks for a tuning meanwhile is refused."""
    one = scene(in_the_step)
    one.loop = one.loop.model_copy(update={"restore_limit_s": 5.0})

    async def main():
        one.device.dead_until_s = 100.0
        manager = managed(one)
        manager.open()
        await asyncio.sleep(40.0)  # between two tries of 5 s, 10 s apart
        told = manager.tunings["T1"].verification.verdict
        with pytest.raises(LoopBusyError):
            manager.start("TIC-101", one.tuning.request)
        await asyncio.sleep(120.0)
        again, seen = manager.tunings["T1"].verification.verdict, await held(one)
        await manager.close()
        return told, again, seen, manager.recovered_loops

    told, again, seen, released = virtual(main())
    assert (told.code, again.code) == ("output_unknown", "interrupted")
    assert {name: seen[name] for name in OLD} == OLD
    assert stands(seen, AT_REST)
    assert [one.done for one in released] == [False, True]


def test_closing_does_not_wait_for_a_dead_link_and_the_next_start_goes_on(scene, virtual):
    one = scene(in_the_step)

    async def main():
        one.device.dead_until_s = 1e6
        manager = managed(one)
        manager.open()
        await asyncio.sleep(5.0)
        before_s = asyncio.get_running_loop().time()
        await manager.close()
        return asyncio.get_running_loop().time() - before_s

    assert virtual(main()) < 1.0
    (kept,) = one.journal.interrupted()
    assert kept.kind is Kind.VERIFICATION


def test_the_shell_gives_it_back_before_it_tunes(scene, virtual):
    one = scene(in_the_step)

    async def main():
        shown = await recover_first("TIC-101", one.loop, one.device, Journal(one.journal.folder, in_place=True))
        return shown, await held(one)

    ((kept, shown),), seen = virtual(main())
    assert (kept.kind, shown.verdict.code, shown.tuning.verdict) == ("verification", "interrupted", one.tuning.verdict)
    assert {name: seen[name] for name in OLD} == OLD
    assert stands(seen, AT_REST)


def test_one_that_comes_to_its_end_leaves_nothing_to_do(scene, virtual):
    one = scene(lambda *_: False)
    assert not one.killed
    assert one.journal.interrupted() == []
    after = started_again(one, virtual)
    assert after.busy is False
    assert {name: after.seen[name] for name in one.new} == one.new


def test_a_device_that_is_not_configured_any_more_is_told(scene, virtual):
    one = scene(in_the_step)
    one.loop = loop_table({"gains": OLD, "seed": 99}, gains=GAINS)
    after = started_again(one, virtual)
    told = after.tuning.verification.verdict
    assert told.code == "output_unknown"
    assert "set point 80 and the old gains" in told.remedy
    assert one.device.written == []


def test_a_loop_that_another_program_still_moves_is_given_back_when_that_is_done(scene, virtual):
    """As the process of a loop does for a moment after its service was killed."""
    one = scene(in_the_step)

    async def main():
        lock = device_lock.acquire(one.journal.folder / "leases" / one.loop.device_key)
        manager = managed(one)
        manager.open()
        await asyncio.sleep(20.0)
        untouched = await held(one)
        with pytest.raises(LoopBusyError):
            manager.start("TIC-101", one.tuning.request)
        lock.release()
        await asyncio.sleep(20.0)
        seen = await held(one)
        await manager.close()
        return untouched, seen

    untouched, seen = virtual(main())
    assert untouched["kp"] == one.new["kp"]
    assert {name: seen[name] for name in OLD} == OLD
    assert stands(seen, AT_REST)


@pytest.fixture
def gain_service(tuned, tmp_path):
    """Return a function that makes a desk on a device, and a tuning with gains for it."""

    def make(script):
        loop = table()
        device = Device(make_backend("simulated", loop.device, "loops.x"))
        device.script = script
        tuning = copy.copy(tuned)
        tuning.device_gains = dict(OLD)
        journal = Journal(tmp_path / "data", in_place=True)
        return GainService("TIC-101", loop, device, journal), tuning, journal, device

    return make


def test_gains_that_the_device_refuses_leave_nothing_to_be_made_good(gain_service, virtual):
    async def refusing(call, _number, names):
        if call == "write" and names.get("ti", OLD["ti"]) != OLD["ti"]:
            raise DeviceRefusedError("is read-only", remedy="Unlock it.")

    one, tuning, journal, device = gain_service(refusing)
    with pytest.raises(DeviceRefusedError):
        virtual(one.use(tuning, InPlace()))
    assert journal.interrupted() == []
    assert device.written[-1] == {"td": OLD["td"]}
    assert tuning.verification is None


def test_gains_that_could_not_be_taken_back_stay_unproved(gain_service, virtual):
    async def lost(call, _number, names):
        if call in {"write", "open"} and ("ti" in names or lost.broken):
            lost.broken = True
            raise LinkError("the line is dead", remedy="Plug it in.")

    lost.broken = False
    one, tuning, journal, _ = gain_service(lost)
    with pytest.raises(LinkError):
        virtual(one.use(tuning, InPlace()))
    (kept,) = journal.left()
    assert (kept.kind, kept.proved, kept.before) == (Kind.VERIFICATION, False, None)
    assert kept.left.code == "not_applied"
    assert "the line is dead" in kept.left.message


def test_on_a_full_disk_no_gain_is_written(gain_service, virtual, monkeypatch):
    def no_space(*_args):
        raise OSError(28, "No space left on device")

    one, tuning, journal, device = gain_service(nothing)
    monkeypatch.setattr("autotuner.control.records.device_lock.os.fsync", no_space)
    with pytest.raises(StorageError):
        virtual(one.use(tuning, InPlace()))
    assert device.written == []
    assert journal.left() == []


async def guard(one):
    await recover_alone(one.loop, one.device, one.journal.folder)


def test_without_a_front_a_recovery_leaves_it_to_the_next_start_to_tell(scene, virtual):
    one = scene(in_the_step)

    async def main():
        await guard(one)
        seen = await held(one)
        device, start_s = one.device.inner.carried()
        one.device.inner.take_over((device, start_s - asyncio.get_running_loop().time()))
        return seen

    seen = virtual(main())
    assert {name: seen[name] for name in OLD} == OLD
    assert stands(seen, AT_REST)
    (kept,) = one.journal.interrupted()
    assert kept.restored
    after = started_again(one, virtual, change={SET_POINT: 66.0, "kp": 0.5})
    assert (after.seen[SET_POINT], after.seen["kp"]) == (66.0, 0.5)
    assert one.device.written == []
    verification = after.tuning.verification
    assert (verification.verdict.code, verification.rolled_back) == ("interrupted", True)
    assert verification.back.now == OLD
    assert verification.back.was["kp"] == one.new["kp"]
    assert "the old gains are restored; the set point is restored to 80" in verification.verdict.message
    assert one.journal.interrupted() == []


def test_what_was_given_back_while_the_next_start_looked_is_not_done_again(scene, virtual, monkeypatch):
    """The journal was read, then somebody gave the loop back, then the lock was had."""
    one = scene(in_the_step)
    stale = one.journal.left()

    async def main():
        await guard(one)
        device, start_s = one.device.inner.carried()
        one.device.inner.take_over((device, start_s - asyncio.get_running_loop().time()))

    virtual(main())
    monkeypatch.setattr(Journal, "left", lambda *_: stale)
    after = started_again(one, virtual)
    assert one.device.written == []
    assert after.tuning.verification.rolled_back


def test_what_it_could_not_give_back_is_left_to_the_next_start(scene, virtual):
    one = scene(in_the_step)
    one.loop = one.loop.model_copy(update={"restore_limit_s": 5.0})

    async def main():
        one.device.dead_until_s = 1e6
        await guard(one)

    virtual(main())
    (kept,) = one.journal.interrupted()
    assert not kept.restored
