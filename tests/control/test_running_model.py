"""The running model of a tuning: where each search starts."""

import numpy as np

from autotuner.application.computing.computations import learned_so_far
from autotuner.application.computing.estimator import estimate_while_running
from autotuner.control.reporting.events import EstimateUpdated
from autotuner.core.identification import RunningModel
from autotuner.core.model.process import Fopdt
from autotuner.core.recording import Recording

ERRORS = {"K": 0.1, "T": 1.0, "D": 0.1}
LEARNED, FIRST, THIRD = (RunningModel(Fopdt(K, 10.0, 2.0), ERRORS, 0.1) for K in (1.0, 2.0, 3.0))
NOT_CLOSE = RunningModel(Fopdt(9.0, 10.0, 2.0), {}, np.inf, explains=False)


class HalfPeriods:
    """A tuning of which only half periods are known."""

    controller = None

    async def follow(self, *, samples=True):
        for k in range(2, 6):
            yield EstimateUpdated(
                t=10.0 * k, half_period=k, period_s=20.0, peak=1.0, fundamental=1.0, ultimate_gain=1.0
            )

    def recording(self):
        return Recording(np.arange(5.0), np.array([0.0, 1.0, 1.0, 0.0, 0.0]), np.arange(5.0))


class Pool:
    """Answers in turn, and keeps what was asked."""

    def __init__(self, answers):
        self.answers, self.begun, self.gains = iter(answers), [], []

    async def aside(self, function):
        return function()

    async def run(self, function, _recording, _noise, last):
        if function is learned_so_far:
            self.gains.append(last)
            return LEARNED
        self.begun.append(last)
        return next(self.answers)


async def test_least_squares_starts_from_its_latest_model_that_explains_the_record():
    pool = Pool([FIRST, NOT_CLOSE, None, THIRD])
    await estimate_while_running(HalfPeriods(), pool)
    assert pool.begun == [LEARNED.model, FIRST.model, FIRST.model, FIRST.model]
    assert pool.gains == [None, (2.0, 0.1), (2.0, 0.1), (2.0, 0.1)]
