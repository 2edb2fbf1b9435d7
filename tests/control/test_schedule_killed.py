"""A run over operating points, killed: the next start gives the tuning's output back, then the set point."""

import asyncio
import os
from types import SimpleNamespace

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.manager import Manager
from autotuner.application.schedule_run import SchedulePlan
from autotuner.application.tuning_run import TuningRequest
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.records.device_lock import acquire
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Kind
from autotuner.core.design import DesignSpec
from autotuner.errors import LoopBusyError
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from tests.control.conftest import loop_table
from tests.control.killed import Device, killed

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="a program is killed in a process of its own"),
    pytest.mark.usefixtures("without_diagnosis"),
]

POINTS = (70.0, 90.0)


def managed(loop, device, folder):
    values = {"service": {"data_directory": str(folder)}, "loops": {"TIC-101": loop.model_dump(exclude_none=True)}}
    ids = iter(["S1", "T1", "T2", "T3"])
    manager = Manager(parse_configuration(values, "test"), InPlace(), lambda: next(ids))
    manager._furnish("TIC-101", loop, device)
    return manager


@pytest.fixture
def scene(tmp_path):
    """Return a function that has a run killed where `die` says, and gives what is there afterwards."""

    def make(die):
        loop = loop_table({"auto": True})
        device = Device(make_backend("simulated", loop.device, "loops.x"), die)
        request = TuningRequest(loop.experiment_settings(check=False), "fopdt", DesignSpec(rule="simc_pi"))

        async def main():
            manager = managed(loop, device, tmp_path)
            run = manager.schedules.start("TIC-101", SchedulePlan(POINTS, request))
            while run.verdict is None:  # noqa: ASYNC110 - a run rings no bell
                await asyncio.sleep(1.0)
            assert run.verdict.code == "scheduled", run.verdict
            await manager.close()

        was_killed = killed(device, main)
        device.reports_to = None
        journal = Journal(tmp_path, in_place=True)
        return SimpleNamespace(loop=loop, device=device, journal=journal, folder=tmp_path, killed=was_killed)

    return make


def started_again(one, virtual, change=None):
    async def main():
        await one.device.inner.open()
        if change:
            await one.device.inner.write(change)
        manager = managed(one.loop, one.device, one.folder)
        manager.open()
        with pytest.raises(LoopBusyError):
            manager.must_be_free("TIC-101")
        await asyncio.sleep(60.0)
        await one.device.inner.open()
        seen = await one.device.inner.read([SET_POINT, OUTPUT, AUTO])
        manager.must_be_free("TIC-101")
        await manager.close()
        return manager, seen

    return virtual(main())


def first_set_point(*, done):
    return lambda _device, call, names, after: call == "write" and names == {SET_POINT} and after is done


def output_of_the_relay(device, call, names, done):
    """Behind a move of the second tuning's relay."""
    points = [values[SET_POINT] for values in device.written if SET_POINT in values]
    outputs = sum(OUTPUT in values for values in device.written)
    return done and call == "write" and names == {OUTPUT} and points == list(POINTS) and outputs % 13 == 0


@pytest.mark.parametrize("done", [False, True], ids=["before", "behind"])
def test_killed_on_the_way_to_a_point(scene, virtual, done):
    one = scene(first_set_point(done=done))
    assert one.killed
    (kept,) = one.journal.interrupted()
    assert (kept.kind, kept.before.set_point, kept.set_points) == (Kind.SCHEDULE, 80.0, {80.0, 70.0})
    manager, seen = started_again(one, virtual)
    assert (seen[SET_POINT], seen[AUTO]) == (80.0, 1.0)
    run = manager.schedules.run("S1")
    assert (run.verdict.code, run.plan.set_points) == ("interrupted", POINTS)
    assert "restored to 80" in run.verdict.message


def test_killed_in_a_tuning_its_output_goes_back_first_then_the_set_point(scene, virtual):
    one = scene(output_of_the_relay)
    assert one.killed
    one.device.written.clear()
    kinds = [kept.kind for kept in one.journal.left()]
    assert kinds == [Kind.TUNING, Kind.SCHEDULE]
    manager, seen = started_again(one, virtual)
    assert (seen[SET_POINT], seen[AUTO]) == (80.0, 1.0)
    assert [next(iter(values)) for values in one.device.written] == [OUTPUT, AUTO, SET_POINT]
    interrupted = manager.tuning("T2")
    assert interrupted.verdict.code == "interrupted"
    assert one.device.written[0][OUTPUT] == interrupted.before.output
    assert manager.schedules.run("S1").to_dict()["tuning_ids"] == ["T1", "T2"]
    assert one.journal.interrupted() == []


def test_a_set_point_that_somebody_has_set_since_is_left(scene, virtual):
    one = scene(first_set_point(done=True))
    manager, seen = started_again(one, virtual, change={SET_POINT: 77.0})
    assert seen[SET_POINT] == 77.0
    assert "77" in manager.schedules.run("S1").verdict.message
    assert one.journal.interrupted() == []


def test_a_set_point_that_could_not_be_recorded_goes_back_from_anywhere(scene, virtual):
    """As on a disk that has filled before the run moved on: only the marker of the device says that it did."""
    one = scene(first_set_point(done=True))
    marker = acquire(one.journal._markers / one.loop.device_key)
    marker.widen()
    marker.release()
    _, seen = started_again(one, virtual, change={SET_POINT: 77.0})
    assert seen[SET_POINT] == 80.0
    assert one.journal.interrupted() == []


def test_it_is_shown_after_every_later_start_too(scene, virtual):
    one = scene(first_set_point(done=True))
    started_again(one, virtual)

    async def main():
        manager = managed(one.loop, one.device, one.folder)
        manager.open()
        await manager.close()
        return manager.schedules.run("S1")

    assert virtual(main()).verdict.code == "interrupted"


@pytest.mark.long  # tests/service runs schedules to their end
def test_one_that_comes_to_its_end_leaves_nothing(scene):
    one = scene(lambda *_: False)
    assert not one.killed
    assert one.journal.left() == []
    assert [values for values in one.device.written if SET_POINT in values][-1] == {SET_POINT: 80.0}
