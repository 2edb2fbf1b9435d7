"""An experiment in a process of its own, with both ends in one event loop of virtual time"""

import asyncio
import logging
from types import SimpleNamespace

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.operations import GRACE_S, LOST_S, Operations
from autotuner.application.remote_controller import RemoteController
from autotuner.control.devices.plugins import make_backend
from autotuner.control.operations.messages import Logged
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.core.verdict import aborted
from autotuner.errors import LinkError
from autotuner.ports import FIRST_PAUSE_S, OUTPUT
from tests.control.conftest import loop_table, nothing
from tests.control.wires import Process

STOPPED = aborted("requested", "somebody asked for it", "Start it again.")


async def for_ever(_call, _number, _names):
    """A device of a process that does nothing any more: no call comes back."""
    await asyncio.Event().wait()


def placed(rig, *, script=nothing, here=nothing, holder=None, **keys):
    """A rig, and a function that conducts its tuning remotely; `script` is that of the process, `here` the owner's."""
    one = rig(here, **keys)
    one.processes = []

    class Lanes:
        async def lane(self, order, _files, process_name):
            one.process_name = process_name
            device = make_backend(order.table.driver, order.table.device, "loops.x")
            device.take_over(order.carried)
            one.processes.append(Process(order, type(one.backend)(device, script)))
            if holder is not None:
                holder.backend = one.processes[-1].backend
            return one.processes[-1]

    def conductor(tuning, loop, _backend):
        operations = Operations("TIC-101", loop, one.device, GainsLedger(None))
        remote = RemoteController(tuning, operations, Lanes(), InPlace())
        operations.backend = one.backend
        return remote

    async def conduct():
        await one.device.open()  # from now on its time is the same at both ends
        return await one.tuning.conduct(one.loop, one.backend, InPlace(), conductor)

    one.conduct_remotely = conduct
    return one


async def until_relay(one):
    """Return once the output has left where it was."""
    async for event in one.tuning.follow():
        if event.type == "sample" and event.output != 40.0:
            return


def in_whole_numbers(holder):
    """A device that holds whole numbers only, which each read-back tells."""

    async def script(call, _number, names):
        written = holder.backend.written[-1:] if holder.backend else []
        return {OUTPUT: float(round(written[0][OUTPUT]))} if call == "read" and OUTPUT in names and written else None

    return script


def test_a_simulated_loop_is_not_in_the_process_of_the_hardware(rig, virtual):
    one = placed(rig)
    virtual(one.conduct_remotely())
    assert one.process_name == "simulated"


@pytest.mark.parametrize(("shared", "stays"), [({}, False), ({"named": "flow"}, True), ({"drives": "flow"}, True)])
def test_only_what_another_loop_shares_stays_in_the_front(shared, stays):
    loop = loop_table(shared)
    device = make_backend(loop.driver, loop.device, "loops.TIC-101")
    assert Operations("TIC-101", loop, device, GainsLedger(None)).stays is stays


def test_nobody_sees_a_difference(rig, virtual):
    async def main(remote):
        one = placed(rig)
        await (one.conduct_remotely() if remote else one.conduct())
        return one.tuning, await one.now(OUTPUT)

    (near, held), (far, held_too) = virtual(main(remote=False)), virtual(main(remote=True))
    assert far.verdict == near.verdict
    assert near.verdict.outcome == "done"
    assert [vars_of(sample) for sample in far.samples] == [vars_of(sample) for sample in near.samples]
    phases = [[event for event in tuning.events if event.type in {"phase", "estimate"}] for tuning in (near, far)]
    assert phases[0] == phases[1]
    assert (far.before, far.controller.restored, far.warnings) == (near.before, True, near.warnings)
    assert far.recording().settings == near.recording().settings
    assert held == held_too == {OUTPUT: 40.0}


def test_what_the_read_back_corrects_is_corrected_in_the_record(rig, virtual):
    async def main(remote):
        holder = SimpleNamespace(backend=None)
        script = in_whole_numbers(holder)
        one = placed(rig, script=script, here=nothing if remote else script, holder=holder)
        holder.backend = None if remote else one.backend
        task = asyncio.create_task(one.conduct_remotely() if remote else one.conduct())
        await until_relay(one)
        await asyncio.sleep(20.0)
        one.tuning.abort(STOPPED)
        await task
        return one.tuning.samples

    near, far = virtual(main(remote=False))[:200], virtual(main(remote=True))[:200]
    assert [vars_of(sample) for sample in far] == [vars_of(sample) for sample in near]
    assert {sample.output for sample in near} == {33.0, 40.0, 53.0}


def vars_of(sample):
    """The numbers of a sample, comparable where they are not there."""
    return [repr(getattr(sample, name)) for name in ("t", "pv", "output", "set_point", "written_s")]


def test_how_sure_a_model_is_reaches_the_experiment(rig, virtual):
    """Models are made by the owner."""

    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        told = []
        one.processes[0].served.operation.controller.experiment.inform = lambda error, *_, **__: told.append(error)
        await task
        return told

    told = virtual(main())
    assert told
    assert all(0.0 < error < 1.0 for error in told)


def test_an_abort_gives_the_loop_back(rig, virtual):
    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        one.tuning.abort(STOPPED)
        return await task, one, await one.now(OUTPUT)

    verdict, one, held = virtual(main())
    assert verdict == STOPPED
    assert held == {OUTPUT: 40.0}
    assert one.tuning.controller.restored is True
    assert one.backend.counts["write"] == 0
    assert one.processes[0].ended == "exit code 0"


def test_an_abort_before_the_process_is_there_moves_nothing(rig, virtual):
    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await asyncio.sleep(0)
        one.tuning.abort(STOPPED)
        return await task, one

    verdict, one = virtual(main())
    assert verdict == STOPPED
    assert not [process for process in one.processes if process.backend.written]


def test_a_cancelled_tuning_gives_the_loop_back_first(rig, virtual):
    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return one, await one.now(OUTPUT)

    one, held = virtual(main())
    assert held == {OUTPUT: 40.0}
    assert one.tuning.verdict.code == "cancelled"


def lost(rig, virtual, lose, after_s=0.0, **keys):
    """The rig whose process was lost in the relay, the verdict, and what the device holds then."""
    gone = SimpleNamespace(yet=False)

    async def script(call, number, names):
        if gone.yet:
            await for_ever(call, number, names)

    async def main():
        one = placed(rig, script=script, restore_limit_s=5.0, **keys)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        await asyncio.sleep(after_s)
        gone.yet = True
        lose(one.processes[0])
        verdict = await task
        held = await one.now(OUTPUT)
        one.processes[0].task.cancel()
        await asyncio.gather(one.processes[0].task, return_exceptions=True)
        return one, verdict, held

    return virtual(main())


def test_the_loop_of_a_process_that_died_is_given_back_from_here(rig, virtual, caplog):
    one, verdict, held = lost(rig, virtual, Process.vanish)
    assert (verdict.outcome, verdict.code) == ("failed", "process_lost")
    assert "SIGKILL" in verdict.message
    assert "restored to 40" in verdict.message
    assert held == {OUTPUT: 40.0}
    assert one.tuning.controller.restored is True
    assert [event.type for event in one.tuning.events[-4:]] == ["phase", "restored", "phase", "ended"]
    times = [event.t for event in one.tuning.events]
    assert times == sorted(times)
    assert "output is being restored" in caplog.text


def test_a_process_that_says_nothing_any_more_is_ended(rig, virtual):
    def hang(process):
        process.theirs.outgoing = asyncio.Queue()

    one, verdict, held = lost(rig, virtual, hang)
    assert verdict.code == "process_lost"
    assert one.processes[0].ended == "SIGKILL"
    assert held == {OUTPUT: 40.0}
    waited_s = next(event.t for event in one.tuning.events if event.type == "restored") - one.tuning.samples[-1].t
    assert LOST_S < waited_s <= LOST_S + GRACE_S + 0.1


def test_where_the_link_is_dead_too_the_output_is_told_to_be_unknown(rig, virtual):
    async def dead(call, _number, _names):
        if call == "open":
            raise LinkError("the line is dead", remedy="Plug it in.")

    one, verdict, _ = lost(rig, virtual, Process.vanish, here=dead)
    assert verdict.code == "output_unknown"
    assert one.tuning.controller.restored is False
    unknown = [event.attempts for event in one.tuning.events if event.type == "output_unknown"]
    assert len(unknown) > 5.0 / (2.0 + FIRST_PAUSE_S)


def test_a_system_without_room_for_a_process_moves_nothing(rig, virtual):
    async def main():
        one = rig()

        class NoRoom:
            async def lane(self, _order, _files, _process_name):
                raise OSError("no room")

        operations = Operations("TIC-101", one.loop, one.device, GainsLedger(None))
        verdict = await one.tuning.conduct(
            one.loop,
            one.device,
            InPlace(),
            lambda tuning, *_: RemoteController(tuning, operations, NoRoom(), InPlace()),
        )
        return verdict, await one.now(OUTPUT)

    verdict, held = virtual(main())
    assert verdict.code == "no_process"
    assert "no room" in verdict.message
    assert held == {OUTPUT: 40.0}


def test_without_its_owner_it_gives_the_loop_back(rig, virtual):
    """The service was killed: nobody takes what is sent, and nothing comes."""

    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        one.processes[0].lose_front()
        await task
        return one, await one.now(OUTPUT)

    one, held = virtual(main())
    assert held == {OUTPUT: 40.0}
    assert one.tuning.verdict.code == "service_lost"


def test_lines_of_the_log_come_over(rig, virtual, caplog):
    async def main():
        one = placed(rig)
        task = asyncio.create_task(one.conduct_remotely())
        await until_relay(one)
        one.processes[0].theirs.send(Logged("there", logging.WARNING, "a thing happened"))
        await asyncio.sleep(1.0)
        one.tuning.abort(STOPPED)
        await task

    virtual(main())
    assert "loop TIC-101: a thing happened" in caplog.text


def test_a_way_back_that_takes_time_is_told_in_the_order_of_time(rig, virtual):
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 1.0}
    one, verdict, held = lost(rig, virtual, Process.vanish, 5.0, limits=limits, sample_time_s=0.5)
    assert verdict.code == "process_lost"
    assert held == {OUTPUT: 40.0}
    times = [event.t for event in one.tuning.events]
    assert times == sorted(times)
