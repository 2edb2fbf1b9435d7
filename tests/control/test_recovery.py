"""What a killed program left behind: the loop goes back first, unless somebody has taken it over since."""

import asyncio
import logging
import math
import sqlite3
from dataclasses import asdict
from itertools import pairwise

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.manager import Manager
from autotuner.application.operations import Operations
from autotuner.application.recovery import earlier_tuning, recover, recover_first
from autotuner.configuration import parse_configuration
from autotuner.control.operations.crash_recovery import CrashRecovery
from autotuner.control.operations.operation import Station
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Before, LeaseRecord
from autotuner.control.records.store import Store
from autotuner.core.recording import Sample
from autotuner.core.verdict import aborted
from autotuner.errors import LinkError, LoopBusyError, OutputUnknownError
from autotuner.ports import AUTO, OUTPUT
from autotuner.service.operations.links import links_of

DEAD = LinkError("the line is dead", remedy="Plug it in.")


def kept_of(one, before, commanded, *later):
    """What a journal would tell of a tuning of the rig's loop."""
    request = {"settings": one.loop.experiment_settings().to_dict(), "structure": "auto", "goal": "balanced"}
    samples = [Sample(0.1 * k, 80.0, 40.0) for k in range(30)]
    device = one.loop.device_key
    kept = LeaseRecord("nowhere", "T9", "TIC-101", device, "then", request, samples=samples)
    for entry in [{"before": asdict(before)}] if before else []:
        kept.take(entry)
    for output in commanded:
        kept.take({"command": output})
    for entry in later:
        kept.take(entry)
    return kept


async def left(one, output, auto=None):
    """Put the device where a killed tuning, or somebody since, left it."""
    await one.device.open()
    await one.device.write({AUTO: 0.0, OUTPUT: output} if auto is None else {OUTPUT: output, AUTO: auto})
    await one.device.close()


def recovered(rig, virtual, before, commanded, output, auto=None, script=None, limit_s=600.0, later=(), **keys):
    """The rig, how it went, and what the device holds after the recovery of a tuning that left it at `output`."""

    async def main():
        gains = {"kp": 0.0, "ti": 0.0, "td": 0.0}
        one = rig(*([script] if script else []), device={"gains": gains}, restore_limit_s=limit_s, **keys)
        await left(one, output, auto)
        kept = kept_of(one, before, commanded, *later)
        station = Station("TIC-101", one.loop, one.backend, GainsLedger(None), InPlace(), one.tuning.publish)
        back = await CrashRecovery(kept, station).go()
        return one, back, await one.now(OUTPUT, AUTO)

    return virtual(main())


def test_an_output_left_at_a_level_of_the_relay_goes_back(rig, virtual):
    one, back, after = recovered(rig, virtual, Before(40.0, 0.0), [53.3, 33.3], 53.3)
    assert back.done
    assert after == {OUTPUT: 40.0, AUTO: 0.0}
    assert [event.type for event in one.tuning.events] == ["restored"]


def test_a_way_to_the_safe_output_is_gone_to_its_end(rig, virtual):
    """Stopped by a limit, killed on the way to the declared safe output: that is where it ends."""
    _, back, after = recovered(rig, virtual, Before(40.0, 0.0), [53.3], 20.0, later=[{"target": 20.0}])
    assert back.done
    assert after == {OUTPUT: 20.0, AUTO: 0.0}


def test_a_loop_that_was_given_back_before_the_kill_is_left_alone(rig, virtual):
    one, back, _ = recovered(rig, virtual, Before(40.0, 0.0), [53.3], 77.0, later=[{"t": 9.0, "phase": "ended"}])
    assert back.done
    assert one.backend.counts["open"] == 0


def test_a_loop_found_in_auto_goes_back_to_auto_after_its_output(rig, virtual):
    one, back, after = recovered(rig, virtual, Before(40.0, 1.0), [53.3], 53.3)
    assert back.done
    assert one.backend.written == [{OUTPUT: 40.0}, {AUTO: 1.0}]
    assert after[AUTO] == 1.0


def test_a_loop_that_is_in_auto_by_now_is_left_alone(rig, virtual):
    one, back, _ = recovered(rig, virtual, Before(40.0, 0.0), [53.3], 53.3, auto=1.0)
    assert back.done
    assert "nothing was written" in back.what
    assert one.backend.written == []


def test_an_output_that_an_operator_has_set_since_is_left_alone(rig, virtual):
    one, back, after = recovered(rig, virtual, Before(40.0, 0.0), [53.3, 33.3], 12.0)
    assert back.done
    assert "12" in back.what
    assert after[OUTPUT] == 12.0
    assert one.backend.written == []


def test_an_output_on_a_slew_limited_way_goes_back_at_that_slew(rig, virtual):
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 5.0}
    one, back, after = recovered(rig, virtual, Before(40.0, 0.0), [50.0], 47.2, limits=limits)
    assert back.done
    assert after[OUTPUT] == 40.0
    written = [47.2, *(values[OUTPUT] for values in one.backend.written)]
    assert max(abs(b - a) for a, b in pairwise(written)) <= 0.5 + 1e-9


def test_a_dead_link_is_tried_until_it_is_back(rig, virtual):
    async def dead_at_first(_call, _number, _names):
        if asyncio.get_running_loop().time() < 30.0:
            raise DEAD

    one, back, after = recovered(rig, virtual, Before(40.0, 0.0), [53.3], 53.3, script=dead_at_first)
    assert back.done
    assert after[OUTPUT] == 40.0
    assert sum(event.type == "output_unknown" for event in one.tuning.events) >= 10


def test_a_link_that_stays_dead_is_told(rig, virtual):
    async def dead(_call, _number, _names):
        raise DEAD

    _, back, _ = recovered(rig, virtual, Before(40.0, 0.0), [53.3], 53.3, script=dead, limit_s=30.0)
    assert not back.done
    assert "40" in back.what


def test_a_tuning_killed_before_it_disturbed_anything(rig, virtual):
    one, back, _ = recovered(rig, virtual, None, [], 53.3)
    assert back.done
    assert one.backend.counts["open"] == 0


@pytest.fixture
def journal(tmp_path):
    return Journal(tmp_path / "data", in_place=True)


async def interrupt(one, journal):
    """Leave behind what a program leaves that is killed 14 s into a tuning: a journal without an end, the output up."""
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    work = asyncio.create_task(one.conduct())
    await asyncio.sleep(14.0)
    held = (await one.now(OUTPUT))[OUTPUT]
    killed = one.tuning.journal
    one.tuning.journal = None
    one.tuning.controller._journal = None
    work.cancel()
    await asyncio.gather(work, return_exceptions=True)
    await killed.end(None)
    await one.device.open()
    await one.device.write({OUTPUT: held})
    return held


def test_before_a_tuning_its_loop_is_given_back(rig, virtual, journal):
    async def main():
        one = rig()
        held = await interrupt(one, journal)
        verdicts = await recover_first("TIC-101", one.loop, one.backend, journal)
        return held, [shown.verdict for _, shown in verdicts], await one.now(OUTPUT)

    held, verdicts, after = virtual(main())
    assert held != 40.0
    assert [verdict.code for verdict in verdicts] == ["interrupted"]
    assert after[OUTPUT] == 40.0
    assert journal.interrupted() == []


def test_a_loop_that_cannot_be_given_back_starts_nothing(rig, virtual, journal):
    async def main():
        one = rig(restore_limit_s=5.0)
        await interrupt(one, journal)

        async def dead(_call, _number, _names):
            raise DEAD

        one.backend.script = dead
        with pytest.raises(LinkError):
            await recover_first("TIC-101", one.loop, one.backend, journal)

    virtual(main())
    assert [kept.tuning for kept in journal.interrupted()] == ["T1"]


def test_another_device_under_the_same_name_is_not_written_to(rig, virtual, journal):
    async def main():
        one = rig()
        await interrupt(one, journal)
        other = rig(device={"seed": 77})
        verdicts = await recover_first("TIC-101", other.loop, other.backend, journal)
        return [shown.verdict for _, shown in verdicts], other.backend.counts

    verdicts, counts = virtual(main())
    assert [verdict.code for verdict in verdicts] == ["output_unknown"]
    assert counts["open"] == 0
    assert [kept.tuning for kept in journal.interrupted()] == ["T1"]


async def over(tuning):
    """Wait until a tuning has ended and let go of its loop."""
    async for _ in tuning.follow():
        pass
    await asyncio.sleep(0.0)


def managed(one, journal):
    """A manager over the rig's device, which counts as hardware because it does not say that it is simulated."""
    table = one.loop.model_dump(exclude_none=True)
    values = {"service": {"data_directory": str(journal.folder)}, "loops": {"TIC-101": table}}
    manager = Manager(parse_configuration(values, "test"), InPlace(), lambda: "T2")
    manager._furnish("TIC-101", one.loop, one.backend)
    return manager


def test_a_new_start_gives_the_loop_back_first_and_then_accepts_work(rig, virtual, journal):
    async def main():
        one = rig()
        await interrupt(one, journal)
        manager = managed(one, journal)
        manager.open()
        request = one.tuning.request
        with pytest.raises(LoopBusyError) as caught:
            manager.start("TIC-101", request)
        await over(manager.tuning("T1"))
        after = await one.now(OUTPUT)
        started = manager.start("TIC-101", request)
        await manager.close()
        return caught.value.tuning_id, after, manager.tuning("T1"), started

    holder, after, tuning, started = virtual(main())
    assert holder == "T1"
    assert after[OUTPUT] == 40.0
    assert tuning.verdict.code == "interrupted"
    assert tuning.recording().t[-1] == pytest.approx(13.9, abs=0.15)
    assert tuning.to_dict()["restored"] is True
    assert tuning.to_dict()["before"] == {"output": 40.0, "auto": 0.0}
    assert [event.type for event in tuning.events][-2:] == ["restored", "ended"]
    assert started.verdict.code == "shutdown"
    assert journal.interrupted() == []


def test_an_interrupted_tuning_is_shown_after_every_later_start_too(rig, virtual, journal):
    async def main():
        one = rig()
        await interrupt(one, journal)
        for _ in range(2):
            manager = managed(one, journal)
            manager.open()
            await over(manager.tuning("T1"))
            await manager.close()
        return manager.tuning("T1")

    tuning = virtual(main())
    assert tuning.verdict.code == "interrupted"
    assert len(tuning.recording()) > 100


def test_a_loop_whose_link_is_dead_is_held_until_it_is_given_back(rig, virtual, journal):
    """Also after the first recovery has given up: the next request begins the next one."""

    async def main():
        one = rig(restore_limit_s=10.0)
        await interrupt(one, journal)
        back_s = asyncio.get_running_loop().time() + 60.0

        async def dead_for_a_minute(_call, _number, _names):
            if asyncio.get_running_loop().time() < back_s:
                raise DEAD

        one.backend.script = dead_for_a_minute
        manager = managed(one, journal)
        manager.open()
        refused = 0
        for _ in range(100):
            try:
                manager.start("TIC-101", one.tuning.request)
            except LoopBusyError:
                refused += 1
                await asyncio.sleep(1.0)
            else:
                break
        seen = await one.now(OUTPUT)
        await manager.close()
        return refused, seen

    refused, seen = virtual(main())
    assert 60 <= refused <= 70
    assert seen[OUTPUT] == 40.0


def test_closing_does_not_wait_for_a_recovery_over_a_dead_link(rig, virtual, journal):
    async def main():
        one = rig()
        await interrupt(one, journal)

        async def dead(_call, _number, _names):
            raise DEAD

        one.backend.script = dead
        manager = managed(one, journal)
        manager.open()
        await asyncio.sleep(5.0)
        before_s = asyncio.get_running_loop().time()
        await manager.close()
        return asyncio.get_running_loop().time() - before_s, manager.tuning("T1")

    waited_s, tuning = virtual(main())
    assert waited_s < 1.0
    assert tuning.verdict.code == "output_unknown"
    assert [kept.tuning for kept in journal.interrupted()] == ["T1"]


def test_a_disk_that_is_full_does_not_keep_the_loop_from_being_given_back(rig, virtual, journal, monkeypatch):
    async def main():
        one = rig()
        await interrupt(one, journal)

        def no_space(*_args):
            raise OSError(28, "No space left on device")

        for name in ("write", "ftruncate", "truncate", "fsync"):
            monkeypatch.setattr(f"os.{name}", no_space)
        manager = managed(one, journal)
        manager.open()
        await over(manager.tuning("T1"))
        after = await one.now(OUTPUT)
        await manager.close()
        return after

    assert virtual(main())[OUTPUT] == 40.0


def test_a_journal_of_another_version_of_the_settings_is_still_made_good(rig, virtual):
    async def main():
        one = rig()
        await left(one, 53.3)
        kept = kept_of(one, Before(40.0, 0.0), [53.3])
        kept.request = {"settings": {"limits": {}}, "wish": "unknown"}
        tuning = earlier_tuning(kept, one.loop)
        done = await recover(tuning, kept, Operations("TIC-101", one.loop, one.backend, GainsLedger(None)))
        return done, tuning, await one.now(OUTPUT)

    done, tuning, after = virtual(main())
    assert done
    assert tuning.verdict.code == "interrupted"
    assert after[OUTPUT] == 40.0
    assert tuning.ended
    assert math.isfinite(tuning.recording().duration_s)


def full(monkeypatch):
    """Have every commit fail from now on, as on a full disk."""

    def no_space(*_args, **_keys):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Store, "_commit", no_space)


async def begun_with(one, journal):
    """A tuning that has its found values on the disk, in its quiet phase."""
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    work = asyncio.create_task(one.conduct())
    await asyncio.sleep(3.0)
    return work


async def die(one, work):
    """End a tuning as a kill does: the device stays as it is, and the lock goes."""
    held = (await one.now(OUTPUT))[OUTPUT]
    killed, one.tuning.journal, one.tuning.controller._journal = one.tuning.journal, None, None
    work.cancel()
    await asyncio.gather(work, return_exceptions=True)
    killed.store.close()
    killed.lock.release()
    await one.device.open()
    await one.device.write({OUTPUT: held})
    return held


def test_a_disk_that_fills_after_the_found_values_does_not_keep_the_loop_from_going_back(
    rig, virtual, journal, monkeypatch
):
    """The relay's levels could not be recorded, and the next start still knows that they are its own."""

    async def main():
        one = rig()
        work = await begun_with(one, journal)
        full(monkeypatch)
        await one.moved()
        held = await die(one, work)
        again = Journal(journal.folder, in_place=True)
        (kept,) = again.left()
        await recover_first("TIC-101", one.loop, one.backend, again)
        return held, kept.wide, await one.now(OUTPUT), Journal(journal.folder).left()

    held, wide, after, left = virtual(main())
    assert abs(held - 40.0) > 5.0
    assert wide
    assert after[OUTPUT] == 40.0
    assert all(kept.restored for kept in left)  # nothing is held


def test_a_loop_without_a_readable_record_is_held_and_reported(rig, virtual, journal, caplog):
    caplog.set_level(logging.INFO)

    async def main():
        one = rig()
        work = await begun_with(one, journal)
        await one.moved()
        held = await die(one, work)
        journal.store.path.write_bytes(b"rubbish" * 4096)
        for suffix in ("-wal", "-shm"):
            journal.store.path.with_name(journal.store.path.name + suffix).unlink(missing_ok=True)
        manager = managed(one, Journal(journal.folder, in_place=True))
        manager.open()
        (link,) = links_of(manager)
        with pytest.raises(OutputUnknownError, match="--confirm TIC-101"):
            manager.start("TIC-101", one.tuning.request)
        untouched = (await one.now(OUTPUT))[OUTPUT]
        manager.journal.confirm("TIC-101", one.loop.device_key)
        started = manager.start("TIC-101", one.tuning.request)
        await manager.close()
        return held, untouched, link, manager, started

    held, untouched, link, manager, started = virtual(main())
    assert untouched == held
    assert (link.link, "is unknown" in link.error) == ("down", True)
    assert [(told.loop, told.done) for told in manager.left.reported] == [("TIC-101", False)]
    assert "the output of loop TIC-101 is unknown" in caplog.text
    assert "a person has confirmed" in caplog.text
    assert started.verdict.code == "shutdown"


@pytest.mark.parametrize("output", [140.0, -3.0])
def test_found_values_outside_the_limits_are_not_written(rig, virtual, output):
    one, back, _ = recovered(rig, virtual, Before(output, 0.0), [53.3], 53.3)
    assert not back.done
    assert "outside of the limits" in back.what
    assert one.backend.written == []


def test_restoring_goes_on_for_as_long_as_the_service_lives(rig, virtual, journal):
    """The limit ends the tuning's waiting; the link comes back five minutes later."""

    async def main():
        one = rig(restore_limit_s=5.0)
        manager = managed(one, journal)
        tuning = manager.start("TIC-101", one.tuning.request)
        await asyncio.sleep(14.0)
        loop = asyncio.get_running_loop()
        back_s = loop.time() + 300.0

        async def dead(_call, _number, _names):
            if loop.time() < back_s:
                raise DEAD

        one.backend.script = dead
        tuning.abort(aborted("requested", "stopped", "Start it again."))
        await over(tuning)
        verdict = tuning.verdict
        await asyncio.sleep(400.0)
        after, told = await one.now(OUTPUT), list(manager.left.reported)
        await manager.close()
        return verdict, after, told

    verdict, after, told = virtual(main())
    assert verdict.code == "output_unknown"
    assert after[OUTPUT] == 40.0
    assert [one.done for one in told][-1]
    assert journal.interrupted() == []
