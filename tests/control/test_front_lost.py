"""Operations in the loop process whose front is lost at one of their writes: the next start tells what was restored.

apply: the old gains        verification: gains, set point, mode, output        operating points: set point
"""

import asyncio
import copy
import os
from functools import partial

import async_solipsism
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.gain_service import GainService
from autotuner.application.manager import Manager
from autotuner.application.recovery import recover_first
from autotuner.application.schedule_run import SchedulePlan
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.operations.messages import WaitNoMore
from autotuner.control.records.device_lock import DeviceLock
from autotuner.control.records.journal import Journal
from autotuner.control.records.open_journal import OpenJournal
from autotuner.control.records.store import Store
from autotuner.core.design import PidGains
from autotuner.errors import AutotunerError, LinkError
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from tests.control.conftest import Faulty, loop_table
from tests.control.killed import Device
from tests.control.wires import Process

OLD = {"kp": 1.0, "ti": 20.0, "td": 0.0}
NEW = {"kp": 1.5, "ti": 12.0, "td": 1.0}
FOUND = {SET_POINT: 80.0, OUTPUT: 40.0, AUTO: 0.0, **OLD}
GAINS = {"form": "ideal", "derivative_filter": 8.0}
VERIFICATION_WRITES = 6
"""Three gains, the set point and the mode of take-over, the step."""


def table(*, auto=False):
    return loop_table({"gains": OLD, "auto": auto}, gains=GAINS)


@pytest.fixture(scope="module")
def tuned():
    """A tuning with gains; never changed, a test has a copy."""
    loop = table()
    made = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings(check=False), "fopdt"))

    async def main():
        await made.conduct(loop, make_backend("simulated", loop.device, "loops.x"), InPlace())

    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(main())
    return made


class Scene:
    """A loop with hardware, whose operations run in processes that are tasks of this event loop."""

    def __init__(self, folder, at=None, lose=Process.lose_front, *, auto=False):
        self.loop, self.folder, self.at, self.lose = table(auto=auto), folder, at, lose
        self.device = Device(make_backend("simulated", self.loop.device, "loops.x"))
        self.journal, self.processes, self.writes = Journal(folder, in_place=True), [], 0
        self.gain_service = GainService("TIC-101", self.loop, self.device, self.journal, self)

    async def lane(self, order, files, _process_name):
        store = Store(self.folder, in_place=True)
        store.open()
        lock = DeviceLock(*map(os.dup, files))
        journal = OpenJournal(store, order.journal.name, lock, in_place=True, within=order.journal.within, resumed=True)
        number = len(self.processes)
        self.processes.append(Process(order, Faulty(self.device, partial(self._script, number)), journal))
        return self.processes[-1]

    async def _script(self, process, call, _number, _names):
        one = self.processes[process]
        if call == "write":
            self.writes += 1
            if self.writes == self.at:
                self.lose(one)
                await asyncio.sleep(0.0 if one.gone else 0.1)
        if one.gone:
            await asyncio.Event().wait()  # of a process that was killed no call comes back

    async def seen(self):
        await self.device.inner.open()
        return await self.device.inner.read([*FOUND])

    async def close(self):
        for process in self.processes:
            process.task.cancel()
            await asyncio.gather(process.task, return_exceptions=True)

    async def next_start(self):
        """What the next start tells, and what it writes."""
        self.device.written.clear()
        journal = Journal(self.folder, in_place=True)
        told = await recover_first("TIC-101", self.loop, self.device, journal)
        return [shown.verdict.message for _, shown in told], self.device.written


def stands(seen, found=FOUND):
    """Whether the device holds what was found; a set point and an output as its own controller has moved them."""
    exact = {name: found[name] for name in (*OLD, SET_POINT, AUTO)}
    return {name: seen[name] for name in exact} == exact and (found[AUTO] or seen[OUTPUT] == found[OUTPUT])


def conducted(virtual, one, work):
    """What the device holds behind some work, what that raised, and what the next start tells and writes."""

    async def main():
        error = None
        try:
            await work()
        except AutotunerError as raised:
            error = raised
        seen = await one.seen()
        told = await one.next_start()
        await one.close()
        return seen, error, *told

    return virtual(main())


@pytest.mark.parametrize("at", [1, 2, 3])
def test_without_a_front_an_apply_puts_the_old_gains_back(tmp_path, virtual, at):
    one = Scene(tmp_path, at)
    seen, _, told, written = conducted(virtual, one, lambda: one.gain_service.write(PidGains(*NEW.values())))
    assert stands(seen)
    assert told == ["the program was killed during the change of gains; the old gains are restored"]
    assert written == []


def test_a_front_lost_behind_the_last_gain_changes_nothing(tmp_path, virtual):
    one = Scene(tmp_path)
    seen, error, told, _ = conducted(virtual, one, lambda: one.gain_service.write(PidGains(*NEW.values())))
    assert (error, told) == (None, [])
    assert {name: seen[name] for name in NEW} == NEW


@pytest.mark.parametrize("at", range(1, VERIFICATION_WRITES + 1))
def test_without_a_front_a_verification_puts_everything_back(tuned, tmp_path, virtual, at):
    one, tuning = Scene(tmp_path, at), copy.copy(tuned)
    tuning.device_gains = dict(OLD)
    seen, _, told, written = conducted(virtual, one, lambda: one.gain_service.use(tuning, InPlace()))
    assert stands(seen)
    assert one.writes > at
    (message,) = told
    killed = "the program was killed during the verification"
    assert message.startswith(f"{killed}; the old gains are restored; the set point")
    assert written == []


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_lost_process_has_the_old_gains_back_by_another_one(tmp_path, virtual, at):
    one = Scene(tmp_path, at, Process.vanish)
    seen, error, told, written = conducted(virtual, one, lambda: one.gain_service.write(PidGains(*NEW.values())))
    assert stands(seen)
    assert isinstance(error, LinkError)
    assert "the process that drove the loop was lost (SIGKILL)" in error.message
    assert "the old gains are restored" in error.message
    assert (told, written) == ([], [])
    assert len(one.processes) == 2


@pytest.mark.parametrize("at", range(1, VERIFICATION_WRITES + 1))
def test_a_lost_process_has_a_verification_put_back_by_another_one(tuned, tmp_path, virtual, at):
    one, tuning = Scene(tmp_path, at, Process.vanish), copy.copy(tuned)
    tuning.device_gains = dict(OLD)
    seen, error, told, _ = conducted(virtual, one, lambda: one.gain_service.use(tuning, InPlace()))
    assert stands(seen)
    assert "the old gains are restored" in error.message
    assert told == []
    assert tuning.applied is None
    assert tuning.verifier is None


def test_a_verification_in_a_process_tells_what_one_in_place_does(tuned, tmp_path, virtual):
    async def verified(name, processes):
        one, tuning = Scene(tmp_path / name), copy.copy(tuned)
        tuning.device_gains = dict(OLD)
        gain_service = one.gain_service if processes else GainService("TIC-101", one.loop, one.device, one.journal)
        run = await gain_service.use(tuning, InPlace())
        await one.close()
        return tuning, run, await one.seen()

    (near, here, held), (far, there, held_too) = (virtual(verified(name, name == "far")) for name in ("near", "far"))
    times = {"started_at", "ended_at"}
    told = [{key: value for key, value in run.to_dict().items() if key not in times} for run in (here, there)]
    assert told[0] == told[1]
    assert there.passed
    assert [event.type for event in here.events] == [event.type for event in there.events]
    assert (far.applied.now, far.device_gains) == (near.applied.now, near.device_gains)
    assert held == held_too


@pytest.mark.parametrize("lose", [Process.lose_front, Process.vanish])
def test_the_set_point_of_a_run_over_operating_points_is_restored(tmp_path, virtual, lose):
    one = Scene(tmp_path, 1, lose, auto=True)
    values = {
        "service": {"data_directory": str(tmp_path)},
        "loops": {"TIC-101": one.loop.model_dump(exclude_none=True)},
    }

    async def work():
        manager = Manager(parse_configuration(values, "test"), InPlace())
        manager._furnish("TIC-101", one.loop, one.device)
        manager._gain_services["TIC-101"] = GainService("TIC-101", one.loop, one.device, manager.journal, one)
        plan = SchedulePlan((70.0, 90.0), TuningRequest(one.loop.experiment_settings(check=False), "fopdt"))
        run = manager.schedules.start("TIC-101", plan)
        while run.verdict is None:  # noqa: ASYNC110 - a run rings no bell
            await asyncio.sleep(1.0)
        codes.append(run.verdict.code)
        await manager.close()

    codes = []
    seen, _, _, written = conducted(virtual, one, work)
    assert (seen[SET_POINT], seen[AUTO]) == (80.0, 1.0)
    assert written == []
    assert codes != ["set_point_unknown"]


def test_the_process_is_told_that_nobody_waits_any_more(tuned, tmp_path, virtual):
    """Whatever the operation: a verification's front is asked twice for the end as that of a tuning is."""
    one, tuning = Scene(tmp_path, VERIFICATION_WRITES, lambda _process: wait_no_more()), copy.copy(tuned)
    tuning.device_gains = dict(OLD)

    async def main():
        work = asyncio.create_task(one.gain_service.use(tuning, InPlace()))
        while not one.processes:  # noqa: ASYNC110 - a test's process rings no bell
            await asyncio.sleep(0.1)
        told, put = [], one.processes[0].wire.send
        one.processes[0].wire.send = lambda message: (told.append(message), put(message))
        await work
        await one.close()
        return told

    assert WaitNoMore() in virtual(main())
