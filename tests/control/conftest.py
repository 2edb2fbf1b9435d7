"""Shared by the tests of the runtime: virtual time, a simulated loop, and a wrapper that injects faults."""

import asyncio

import async_solipsism
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.core.design import DesignSpec
from autotuner.ports import OUTPUT

PLANT = {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}


@pytest.fixture
def virtual():
    """Return a function that runs a coroutine on a loop whose clock jumps to the next timer."""

    def run(main):
        with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
            return runner.run(main)

    return run


def loop_table(device=None, **keys):
    """A checked loop on the simulated driver."""
    device = {"plant": PLANT, "output0": 40.0, "pv0": 80.0, "noise": 0.05, "seed": 3} | (device or {})
    table = {
        "driver": "simulated",
        "sample_time_s": 0.1,
        "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
        "relay": {"amplitude": 10.0},
        "device": device,
    } | keys
    return parse_configuration({"loops": {"TIC-101": table}}, "test").loop("TIC-101")


class Faulty:
    """A backend around another one that does what a script says before a call.

    `script(call, number, names)` is awaited before each call; what it raises is raised, what it returns (unless None)
    replaces the answer of a read.
    """

    def __init__(self, inner, script):
        self.inner = inner
        self.script = script
        self.counts = {"open": 0, "read": 0, "write": 0, "close": 0}
        self.written = []

    @property
    def readable(self):
        return self.inner.readable

    @property
    def writable(self):
        return self.inner.writable

    async def _before(self, call, names=()):
        self.counts[call] += 1
        return await self.script(call, self.counts[call], names)

    async def open(self):
        await self._before("open")
        await self.inner.open()

    async def read(self, names):
        replaced = await self._before("read", names)
        seen = await self.inner.read(names)
        return seen if replaced is None else seen | replaced

    async def write(self, values):
        await self._before("write", values)
        self.written.append(dict(values))
        await self.inner.write(values)

    async def close(self):
        await self._before("close")
        await self.inner.close()


async def nothing(_call, _number, _names):
    """The script without faults."""


BY_RULE = DesignSpec(rule="simc_pi")
"""Gains by a formula: a search takes most of the time of an analysis, and few tests of this folder use its gains."""


class Rig:
    """One loop with its tuning, for a test to conduct."""

    def __init__(self, script=nothing, device=None, spec=BY_RULE, **keys):
        self.loop = loop_table(device, **keys)
        self.device = make_backend("simulated", self.loop.device, "loops.TIC-101")
        self.backend = Faulty(self.device, script)
        self.tuning = TuningRun("T1", "TIC-101", TuningRequest(self.loop.experiment_settings(), spec=spec))

    async def conduct(self):
        return await self.tuning.conduct(self.loop, self.backend, InPlace())

    async def now(self, *names):
        """What the device holds, asked past the wrapper."""
        await self.device.open()
        return await self.device.read(names)

    async def moved(self):
        """Wait until the relay has begun."""
        before = (await self.now(OUTPUT))[OUTPUT]
        for _ in range(1000):
            if abs((await self.now(OUTPUT))[OUTPUT] - before) > 5.0:
                return
            await asyncio.sleep(0.1)
        raise AssertionError("the relay never began")


@pytest.fixture
def rig():
    """The maker of rigs."""
    return Rig
