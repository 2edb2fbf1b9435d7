"""A line on which writes and readings are now and then late: what the record leaves open is stated, also for a rule."""

import asyncio

import async_solipsism
import numpy as np
import pytest

from autotuner.application.analysis import procedure
from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import LoopTable
from autotuner.core.design import DesignSpec
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner_sim import Fopdt, SteppedPlant

K, OUTPUT0, PV0, STEP = 2.0, 30.0, 60.0, 0.1
LATE, MEAN_S, LONGEST_S = 0.2, 0.2, 1.0
"""Share of the accesses that are late, and by how much, s: a serial line of a busy computer, sampled every 0.25 s."""
LOOP = {
    "driver": "simulated",
    "sample_time_s": 0.25,
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
    "relay": {"amplitude": 10.0, "quiet_s": 2.0, "min_periods": 2, "check": False},
    "device": {"plant": {"structure": "fopdt", "K": K, "T": 10.0, "D": 1.5}},
}


class LateDevice:
    """A backend whose accesses are late by chance; its PV has steps of 0.1."""

    readable = frozenset({PV, OUTPUT, AUTO, SET_POINT})
    writable = frozenset({OUTPUT, AUTO})

    def __init__(self, seed):
        self.plant = SteppedPlant(Fopdt(K, 10.0, 1.5), output0=OUTPUT0, pv0=PV0)
        self.rng, self.auto = np.random.default_rng(seed), False

    async def open(self):
        pass

    async def close(self):
        pass

    async def _late(self):
        if self.rng.random() < LATE:
            await asyncio.sleep(float(min(self.rng.exponential(MEAN_S), LONGEST_S)))
        self.plant.advance(asyncio.get_running_loop().time())

    async def read(self, names):
        self.plant.advance(asyncio.get_running_loop().time())
        values = {PV: round(self.plant.pv / STEP) * STEP, OUTPUT: self.plant.output}
        return {name: {**values, SET_POINT: PV0, AUTO: float(self.auto)}[name] for name in names}

    async def write(self, values):
        await self._late()
        self.auto = bool(values.get(AUTO, self.auto))
        self.plant.output = float(values.get(OUTPUT, self.plant.output))
        await self._late()


def recorded(rule=None):
    """Return a tuning of the late device."""
    loop = LoopTable.model_validate(LOOP)
    tuning = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings(), spec=DesignSpec(rule=rule)))
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(tuning.conduct(loop, LateDevice(5), InPlace()))
    return tuning


@pytest.mark.long  # tests/identification has the interval, tests/control late accesses
def test_the_interval_of_the_gain_holds_it_and_the_experiment_is_that_of_any_tuning(monkeypatch):
    monkeypatch.setattr(procedure, "analyse", procedure.identified)
    by_rule, usual = recorded("simc_pi"), recorded()
    assert [(s.t, s.pv, s.output) for s in by_rule.samples] == [(s.t, s.pv, s.output) for s in usual.samples]
    found = by_rule.analysis.identification
    low, high = found.estimates[found.recommended].interval95["K"]
    assert low <= K <= high
    assert (high - low) / 2.0 > 0.1 * found.model.K
    assert any("leaves K uncertain" in text for text in by_rule.notes)
