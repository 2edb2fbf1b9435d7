"""A program killed at one of its calls to a device, as `kill -9` does it: nothing of it runs on, no lock is left."""

import asyncio
import os
import pickle
import traceback

import async_solipsism

from autotuner.application.computing.compute_pool import InPlace
from autotuner.control.operations.crash_recovery import Recover
from autotuner.control.operations.operation import Station
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.journal import Journal
from autotuner.errors import LinkError
from tests.control.conftest import Faulty


class Device(Faulty):
    """A simulated device that counts as hardware; `die` is asked before and after each call."""

    def __init__(self, inner, die=lambda _device, _call, _names, _done: False):
        super().__init__(inner, self._alive)
        self.die = die
        self.dead_until_s = 0.0
        self.reports_to = None

    async def _alive(self, call, _number, names):
        if asyncio.get_running_loop().time() < self.dead_until_s:
            raise LinkError("the line is dead", remedy="Plug it in.")
        self._perhaps_die(call, names, done=False)

    async def write(self, values):
        await super().write(values)
        self._perhaps_die("write", values, done=True)

    def _perhaps_die(self, call, names, *, done):
        if self.reports_to is not None and self.die(self, call, set(names), done):
            report(self.reports_to, self)


async def recover_alone(loop, device, folder):
    """Release what a killed program left, in a loop process whose front is gone before that is done."""
    journal = Journal(folder, in_place=True)
    for kept in journal.left("TIC-101"):
        record = journal.resume(kept)
        ledger = GainsLedger(journal.store, "TIC-101", in_place=True)
        station = Station("TIC-101", loop, device, ledger, InPlace(), lambda _: None, record, alone=True)
        await Recover(journal.again(kept)).begin(station).run()
        await record.end(None)


def report(to, device):
    """End this process at once, telling how the device stands now."""
    inner, start_s = device.inner.carried()
    now_s = 0.0 if start_s is None else asyncio.get_running_loop().time() - start_s
    with os.fdopen(to, "wb") as pipe:
        pickle.dump((inner, now_s, device.written), pipe)
    os._exit(9)


def killed(device, main):
    """Run `main()` in a process until `device` has it die; leave the device as it stands then, at time 0 of a new loop.

    Returns whether it was killed; one that came to its end tells too how the device stands.
    """
    ours, theirs = os.pipe()
    if (child := os.fork()) == 0:
        os.close(ours)
        device.reports_to = theirs
        _live(device, main, theirs)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        told = pipe.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert told, f"the process failed, exit code {code}: see its traceback"
    inner, now_s, device.written = pickle.loads(told)  # noqa: S301 - our own process told it
    device.inner.take_over((inner, -now_s))
    return code == 9


def _live(device, main, to):
    code = 1
    try:
        with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
            runner.run(main())
            with os.fdopen(to, "wb") as pipe:
                inner, start_s = device.inner.carried()
                pickle.dump((inner, runner.get_loop().time() - (start_s or 0.0), device.written), pipe)
        code = 0
    except BaseException:  # noqa: BLE001 - whatever it is, this process must not go on as a second pytest
        traceback.print_exc()
    finally:
        os._exit(code)
