"""Gains that are written, or put back, killed at every one of their writes: the device never keeps some of each."""

import asyncio
import os
from types import SimpleNamespace

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.gain_service import GainService
from autotuner.application.manager import Manager
from autotuner.application.operations import Operations
from autotuner.application.recovery import EarlierGains, recover, recover_first
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.gains.apply import UNDO_LIMIT_S
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Before, Kind, LeaseRecord
from autotuner.control.records.open_journal import OpenJournal
from autotuner.core.design import PidGains
from autotuner.errors import DeviceRefusedError, GainsChangedError, LinkError, LoopBusyError, StorageError
from tests.control.conftest import loop_table, nothing
from tests.control.killed import Device, killed, recover_alone

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="a program is killed in a process of its own")

OLD = {"kp": 1.0, "ti": 20.0, "td": 0.0}
FIRST = {"kp": 1.5, "ti": 12.0, "td": 1.0}
SECOND = {"kp": 2.5, "ti": 8.0, "td": 2.0}
NAMES = tuple(OLD)


def table(**keys):
    return loop_table({"gains": OLD}, gains={"form": "ideal"}, **keys)


def pid(values):
    return PidGains(values["kp"], values["ti"], values["td"])


def before(number):
    """Die before the write of that number."""
    return lambda device, call, _names, done: call == "write" and not done and len(device.written) == number


def behind(number):
    """Die behind it."""
    return lambda device, call, _names, done: call == "write" and done and len(device.written) == number + 1


def never(*_):
    return False


@pytest.fixture
def scene(tmp_path):
    """Return a function that has a change of gains killed, and gives what is there afterwards."""

    def make(die, work, *, loop=None):
        loop = loop or table()
        device = Device(make_backend("simulated", loop.device, "loops.x"), die)
        journal = Journal(tmp_path / "data", in_place=True)
        gain_service = GainService("TIC-101", loop, device, journal)
        was_killed = killed(device, lambda: work(gain_service))
        device.reports_to = None
        return SimpleNamespace(loop=loop, device=device, journal=journal, killed=was_killed)

    return make


async def apply_once(gain_service):
    await gain_service.write(pid(FIRST))


async def apply_twice(gain_service):
    await gain_service.write(pid(FIRST))
    await gain_service.write(pid(SECOND))


async def roll_back(gain_service):
    await gain_service.write(pid(FIRST))
    await gain_service.roll_back()


async def held(one):
    await one.device.inner.open()
    return await one.device.inner.read(NAMES)


def managed(one):
    """A manager over the device, as the next start of the service has it."""
    raw = one.loop.model_dump(exclude_none=True)
    values = {"service": {"data_directory": str(one.journal.folder)}, "loops": {"TIC-101": raw}}
    manager = Manager(parse_configuration(values, "test"), InPlace(), lambda: "T2")
    manager._furnish("TIC-101", one.loop, one.device)
    return manager


def by_the_next_start(one, virtual, *, change=None, wait_s=100.0):
    """What the device holds after the next start, and what that told."""

    async def main():
        if change:
            await one.device.inner.open()
            await one.device.inner.write(change)
        manager = managed(one)
        manager.open()
        with pytest.raises(LoopBusyError):
            manager.must_be_free("TIC-101")
        await asyncio.sleep(wait_s)
        seen = await held(one)
        told = [(given.kind, given.loop, given.done) for given in manager.recovered_loops]
        await manager.close()
        return seen, told

    return virtual(main())


def by_a_process_alone(one, virtual):
    async def main():
        await recover_alone(one.loop, one.device, one.journal.folder)
        return await held(one)

    return virtual(main())


@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
@pytest.mark.parametrize("who", ["start", "process alone"])
def test_killed_at_a_write_of_an_apply_the_old_gains_are_back(scene, virtual, caplog, number, moment, who):
    one = scene(moment(number), apply_once)
    assert one.killed
    (kept,) = one.journal.interrupted()
    assert (kept.kind, kept.proved, kept.found) == (Kind.GAINS, False, OLD)
    if who == "process alone":
        assert by_a_process_alone(one, virtual) == OLD
        assert one.journal.interrupted()
        one.device.written.clear()
    with caplog.at_level("INFO"):
        seen, told = by_the_next_start(one, virtual)
    assert seen == OLD
    assert "the program was killed during the change of gains; the old gains are restored" in caplog.text
    assert told == [(Kind.GAINS, "TIC-101", True)]
    assert one.journal.interrupted() == []
    assert who == "start" or one.device.written == []


@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
@pytest.mark.parametrize("number", range(3, 6), ids=NAMES)
def test_killed_at_a_write_of_the_second_apply_the_first_ones_are_back(scene, virtual, number, moment):
    """Undone is the change that was under way, and no earlier one with it."""
    one = scene(moment(number), apply_twice)
    assert one.killed
    assert by_the_next_start(one, virtual)[0] == FIRST
    gain_service = GainService("TIC-101", one.loop, one.device, one.journal)
    assert virtual(gain_service.ledger.latest()).wanted == FIRST


@pytest.mark.parametrize("moment", [before, behind], ids=["before", "behind"])
@pytest.mark.parametrize("number", range(3, 6), ids=NAMES)
def test_killed_at_a_write_of_a_rollback_that_is_brought_to_its_end(scene, virtual, number, moment):
    one = scene(moment(number), roll_back)
    assert one.killed
    assert by_the_next_start(one, virtual)[0] == OLD


@pytest.mark.parametrize("number", range(3, 6), ids=NAMES)
def test_killed_at_a_write_of_a_forced_rollback_it_knows_what_it_was_writing_over(scene, virtual, number):
    async def forced(gain_service):
        await gain_service.write(pid(FIRST))
        await gain_service._backend.inner.open()
        await gain_service._backend.inner.write({"ti": 99.0, "td": 7.0})
        await gain_service.roll_back(force=True)

    one = scene(before(number), forced)
    assert one.killed
    assert by_the_next_start(one, virtual)[0] == OLD


def test_killed_behind_the_reading_back_the_new_gains_stay(scene, virtual, monkeypatch):
    """What was read back is a whole controller, and the one that was asked for."""
    one = scene(lambda _device, call, _names, _done: call == "close", apply_once)
    assert one.killed
    (kept,) = one.journal.interrupted()
    assert kept.proved
    assert by_the_next_start(one, virtual)[0] == FIRST
    assert one.journal.interrupted() == []


def test_what_came_to_its_end_leaves_nothing_to_be_made_good(scene):
    one = scene(never, apply_twice)
    assert not one.killed
    assert one.journal.interrupted() == []
    assert [kept.kind for kept in one.journal.made_good()] == []


def test_gains_that_somebody_has_set_since_are_left(scene, virtual, caplog):
    one = scene(behind(0), apply_once)
    with caplog.at_level("INFO"):
        seen, _ = by_the_next_start(one, virtual, change={"ti": 33.0})
    assert seen == FIRST | {"ti": 33.0, "td": 0.0}
    assert "the gains were left: ti is 33 in the device" in caplog.text
    assert one.journal.interrupted() == []


def test_over_a_dead_link_it_is_tried_again_and_until_then_nothing_new_is_begun(scene, virtual):
    one = scene(behind(1), apply_once, loop=table(restore_limit_s=5.0))

    async def main():
        one.device.dead_until_s = 60.0
        gain_service = GainService("TIC-101", one.loop, one.device, Journal(one.journal.folder, in_place=True))
        with pytest.raises(LinkError, match="the old gains are not back"):
            await recover_first("TIC-101", one.loop, one.device, gain_service._journal)
        await asyncio.sleep(60.0)
        (shown,) = [shown for _, shown in await recover_first("TIC-101", one.loop, one.device, gain_service._journal)]
        return shown.verdict, await held(one)

    verdict, seen = virtual(main())
    assert verdict.code == "interrupted"
    assert seen == OLD


def test_a_ledger_that_another_program_has_written_to_is_read_anew(scene, virtual):
    """A service that had looked before the command was killed."""
    one = scene(behind(0), apply_once)

    async def main():
        manager = managed(one)
        manager.gain_service("TIC-101").ledger._kept = []
        manager.open()
        await asyncio.sleep(100.0)
        await manager.close()
        return await held(one)

    assert virtual(main()) == OLD


@pytest.fixture
def gain_service(tmp_path):
    """A desk over a device that does what a script says, with the journals."""

    def make(script):
        loop = table(restore_limit_s=5.0)
        device = Device(make_backend("simulated", loop.device, "loops.x"))
        device.script = script
        journal = Journal(tmp_path / "data", in_place=True)
        return GainService("TIC-101", loop, device, journal), journal, device

    return make


def test_a_refused_gain_whose_old_ones_are_back_leaves_nothing_to_be_made_good(gain_service, virtual):
    async def refusing(call, _number, names):
        if call == "write" and names.get("ti", OLD["ti"]) != OLD["ti"]:
            raise DeviceRefusedError("is read-only", remedy="Unlock it.")

    one, journal, device = gain_service(refusing)
    with pytest.raises(DeviceRefusedError, match="the old gains are restored"):
        virtual(one.write(pid(FIRST)))
    assert journal.interrupted() == []
    assert device.written[-1] == {"td": OLD["td"]}


def dead_from_ti():
    """The script of a line that breaks with the second gain."""

    async def lost(call, _number, names):
        if call in {"write", "open"} and ("ti" in names or lost.broken):
            lost.broken = True
            raise LinkError("the line is dead", remedy="Plug it in.")

    lost.broken = False
    return lost


def test_old_gains_that_could_not_be_confirmed_are_left_to_the_next_program(gain_service, virtual, caplog):
    one, journal, device = gain_service(dead_from_ti())
    with pytest.raises(LinkError, match="the gains in the device are unknown"):
        virtual(one.write(pid(FIRST)))
    (kept,) = journal.left()
    assert (kept.kind, kept.proved) == (Kind.GAINS, False)
    assert "the gains in the device are unknown" in kept.left.message

    device.script = nothing
    caplog.clear()
    with caplog.at_level("INFO"):
        seen, _ = by_the_next_start(SimpleNamespace(loop=one._loop, device=device, journal=journal), virtual)
    assert seen == OLD
    assert "the line is dead" in caplog.text
    assert "could not be released at that end, later the old gains are restored" in caplog.text
    assert "killed" not in caplog.text


def test_on_a_full_disk_no_gain_is_written(gain_service, virtual, monkeypatch):
    def no_space(*_args):
        raise OSError(28, "No space left on device")

    one, journal, device = gain_service(nothing)
    monkeypatch.setattr("autotuner.control.records.device_lock.os.fsync", no_space)
    with pytest.raises(StorageError):
        virtual(one.write(pid(FIRST)))
    assert device.written == []
    assert journal.left() == []


def test_a_refusal_before_the_first_write_leaves_nothing(gain_service, virtual):
    one, journal, device = gain_service(nothing)
    with pytest.raises(GainsChangedError):
        virtual(one.write(pid(FIRST), expected={"kp": 9.0, "ti": 20.0, "td": 0.0}))
    assert device.written == []
    assert journal.left() == []


def test_who_gives_up_waiting_is_told_what_came_of_it(gain_service, virtual):
    """A call that is cancelled, twice: the writing comes to its end, and is known to have."""

    async def slow(call, _number, _names):
        if call == "write":
            await asyncio.sleep(1.0)

    one, journal, device = gain_service(slow)

    async def main():
        work = asyncio.create_task(one.write(pid(FIRST)))
        for _ in range(2):
            await asyncio.sleep(0.75)
            work.cancel()
        applied = await work
        await device.inner.open()
        return applied, work.cancelling(), await device.inner.read(NAMES)

    applied, cancelling, seen = virtual(main())
    assert applied.now == seen == FIRST
    assert cancelling == 0
    assert journal.left() == []


def test_who_gives_up_before_the_first_write_has_written_nothing(gain_service, virtual):
    async def slow(call, _number, _names):
        if call == "read":
            await asyncio.sleep(10.0)

    one, journal, device = gain_service(slow)

    async def main():
        work = asyncio.create_task(one.write(pid(FIRST)))
        await asyncio.sleep(1.5)
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        return work.cancelled()

    assert virtual(main())
    assert device.written == []
    assert journal.left() == []


@pytest.mark.parametrize("dead_s", [10.0, 1000.0])
def test_a_rollback_over_a_line_that_breaks_goes_on_until_its_limit(gain_service, virtual, dead_s):
    """From the second gain of the rollback on."""
    dead_until_s = None

    async def lost(call, _number, names):
        nonlocal dead_until_s
        now_s = asyncio.get_running_loop().time()
        if rolling and dead_until_s is None and call == "write" and "ti" in names:
            dead_until_s = now_s + dead_s
        if dead_until_s is not None and now_s < dead_until_s:
            raise LinkError("the line is dead", remedy="Plug it in.")

    one, journal, _ = gain_service(lost)
    rolling = False

    async def main():
        nonlocal rolling
        await one.write(pid(FIRST))
        rolling = True
        return await one.roll_back()

    if dead_s < UNDO_LIMIT_S:
        assert virtual(main()).now == OLD
        assert journal.left() == []
        return
    with pytest.raises(LinkError, match="the gains in the device are unknown") as told:
        virtual(main())
    assert "set them by hand: kp 1, ti 20, td 0" in told.value.remedy
    assert len(journal.left()) == 1


@pytest.mark.parametrize("again_s", [20.0, None])
def test_asked_twice_for_the_end_it_waits_no_more_for_a_dead_line(gain_service, virtual, again_s):
    """Dead from the second gain on: the old ones are tried again until the limit, or until it is enough."""
    one, journal, _ = gain_service(dead_from_ti())

    async def main():
        now_s = asyncio.get_running_loop().time
        begun_s, work = now_s(), asyncio.create_task(one.write(pid(FIRST)))
        await asyncio.sleep(10.0)
        work.cancel()
        if again_s is not None:
            await asyncio.sleep(again_s - 10.0)
            wait_no_more()
        with pytest.raises(LinkError, match="the gains in the device are unknown") as told:
            await work
        return now_s() - begun_s, told.value

    waited_s, told = virtual(main())
    assert waited_s == pytest.approx(again_s, abs=0.01) if again_s else waited_s >= UNDO_LIMIT_S
    assert "set them by hand: kp 1, ti 20, td 0" in told.remedy
    (kept,) = journal.left()
    assert kept.left.message == told.message


def test_asked_twice_what_a_killed_program_left_is_not_waited_for(scene, virtual):
    one = scene(behind(1), apply_once, loop=table(restore_limit_s=600.0))

    async def main():
        one.device.dead_until_s = 1000.0
        now_s = asyncio.get_running_loop().time
        work = asyncio.create_task(recover_first("TIC-101", one.loop, one.device, one.journal))
        await asyncio.sleep(20.0)
        wait_no_more()
        with pytest.raises(LinkError, match="the old gains are not back"):
            await work
        return now_s()

    assert virtual(main()) < 30.0
    assert len(one.journal.interrupted()) == 1


def test_a_rollback_that_had_ended_before_its_program_was_lost_is_reported(virtual):
    loop, shown = table(), EarlierGains("TIC-101")
    backend = make_backend("simulated", loop.device, "loops.x")
    operations = Operations("TIC-101", loop, backend, GainsLedger(None, "TIC-101"))
    ended = LeaseRecord("k", "rollback", "TIC-101", "d", "now", {}, kind=Kind.GAINS, proved=False, restored=True)
    assert virtual(recover(shown, ended, operations))
    assert shown.verdict.message.endswith("; the old gains are restored")


def test_a_loop_that_its_process_had_restored_is_reported_as_such_whatever_fails_now(virtual):
    def broken(*_):
        raise RuntimeError("no room")

    shown = EarlierGains("TIC-101")
    kept = LeaseRecord("k", "T1", "TIC-101", "d", "now", {}, before=Before(40.0, 1.0), restored=True)
    assert virtual(recover(shown, kept, SimpleNamespace(begin=broken)))
    assert shown.verdict.message.endswith("; the process of the loop had restored it")


def test_a_start_that_is_stopped_once_the_gains_are_back_reports_it(scene, virtual, caplog, monkeypatch):
    """The next one finds a record that has ended, and would have nothing to report."""
    one, end, ended = scene(behind(1), apply_once), OpenJournal.end, asyncio.Event()

    async def end_slowly(journal, verdict):
        await end(journal, verdict)
        ended.set()
        await asyncio.sleep(1.0)

    monkeypatch.setattr(OpenJournal, "end", end_slowly)

    async def main():
        manager = managed(one)
        manager.open()
        await ended.wait()
        await manager.close()
        return await held(one)

    with caplog.at_level("INFO"):
        assert virtual(main()) == OLD
    assert one.journal.interrupted() == []
    assert "the program was killed during the change of gains; the old gains are restored" in caplog.text
