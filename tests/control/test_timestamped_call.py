"""A line on which readings and writes take seconds: the record holds when they happened, and the model is right."""

import asyncio
import math
from itertools import pairwise

import numpy as np
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.control.clock.ticker import Ticker
from autotuner.control.clock.timestamped_call import timed
from autotuner.core.identification import identify
from autotuner.ports import OUTPUT

pytestmark = pytest.mark.usefixtures("without_diagnosis")

TRIP_S = (0.02, 0.4)
"""Shortest and longest time of one exchange, there and back."""
PATIENCE_S = 0.6
"""What an attempt without an answer costs."""
LOST = 0.25
"""Share of the attempts without an answer."""
MOST_ATTEMPTS = 3


class Bad:
    """A device behind a bad line: what happens there happens in the middle of the attempt that succeeds."""

    def __init__(self, inner, seed):
        self.inner, self.random = inner, np.random.default_rng(seed)
        self.moment_s, self.repeated = math.nan, 0
        self.outputs, self.took_s = [], []

    @property
    def readable(self):
        return self.inner.readable

    @property
    def writable(self):
        return self.inner.writable

    async def open(self):
        await self.inner.open()

    async def close(self):
        await self.inner.close()

    async def read(self, names):
        return await self._over_the_line(self.inner.read(names))

    async def write(self, values):
        await self._over_the_line(self.inner.write(values))
        if OUTPUT in values:
            self.outputs.append((self.moment_s, values[OUTPUT]))

    async def _over_the_line(self, call):
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        for _ in range(MOST_ATTEMPTS - 1):
            if self.random.random() < LOST:
                await asyncio.sleep(PATIENCE_S)
                self.repeated += 1
        trip_s = self.random.uniform(*TRIP_S)
        await asyncio.sleep(trip_s / 2.0)
        result, self.moment_s = await call, loop.time()
        await asyncio.sleep(trip_s / 2.0)
        self.took_s.append(loop.time() - started_s)
        return result


class Untold(Bad):
    """The same line under a driver that does not tell the moments: the middle of the call has to do."""

    moment_s = property(lambda _: math.nan, lambda *_: None)


def conducted(rig, virtual, line, seed):
    """Tune the plant K 2, T 30 s, D 4 s, sampled every 0.5 s, over a bad line; return the tuning and the line."""
    one = rig(
        device={"plant": {"structure": "fopdt", "K": 2.0, "T": 30.0, "D": 4.0}, "seed": seed},
        sample_time_s=0.5,
    )
    bad = line(one.device, seed)
    virtual(one.tuning.conduct(one.loop, bad, InPlace()))
    return one.tuning, bad


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))])
def test_a_line_that_takes_up_to_two_seconds_does_not_spoil_the_model(rig, virtual, seed):
    tuning, line = conducted(rig, virtual, Bad, seed)
    assert max(line.took_s) > 1.2
    assert tuning.succeeded, tuning.verdict
    model = tuning.analysis.identification.model
    assert model.parameters() == pytest.approx({"K": 2.0, "T": 30.0, "D": 4.0}, rel=0.03)
    assert sum(f"{line.repeated} requests in" in warning for warning in tuning.warnings) == 1


def test_the_record_holds_when_each_output_was_set(rig, virtual):
    tuning, line = conducted(rig, virtual, Bad, 1)
    recording = tuning.recording()
    rows = np.flatnonzero(np.diff(recording.output)) + 1
    set_s = [moment for (_, before), (moment, after) in pairwise([(0.0, 40.0), *line.outputs]) if before != after]
    assert recording.acts_s[rows] == pytest.approx(set_s[: rows.size], abs=1e-9)
    assert (recording.acts_s[rows] > recording.t[rows]).all()


def test_without_those_times_the_same_record_is_far_off(rig, virtual):
    """What the record was worth when an output counted from the sample it was decided on."""
    tuning, _ = conducted(rig, virtual, Bad, 1)
    recording = tuning.recording()
    blind = type(recording)(recording.t, recording.output, recording.pv, settings=recording.settings)
    model = identify(blind, "fopdt").model
    assert abs(model.D / 4.0 - 1.0) > 0.05


def test_a_driver_that_does_not_tell_leaves_the_middle_of_the_call(virtual):
    async def main():
        ticker = Ticker(1.0)
        line = Untold(None, 1)
        await asyncio.sleep(1.0)
        _, moment_s = await timed(asyncio.sleep(0.5), line, ticker)
        return moment_s

    assert virtual(main()) == pytest.approx(1.25)


@pytest.mark.parametrize("told_s", [-7.0, 99.0])
def test_a_moment_lies_within_its_call(virtual, told_s):
    async def main():
        line = Bad(None, 1)
        line.moment_s = told_s
        await asyncio.sleep(1.0)
        _, moment_s = await timed(asyncio.sleep(0.5), line, Ticker(1.0))
        return moment_s

    assert 0.0 <= virtual(main()) <= 0.5
