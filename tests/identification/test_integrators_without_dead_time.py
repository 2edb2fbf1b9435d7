"""An integrator without lag and dead time has no number that could be the unit of a change."""

import numpy as np
import pytest

from autotuner.core.estimation.initial_guesses import Start
from autotuner.core.estimation.noise.ar_noise import Memory
from autotuner.core.estimation.prewhitening import _moved


def test_a_dead_time_that_stays_at_zero_has_not_moved():
    nothing = Start((), 0.0, 0.0)
    assert _moved(nothing, nothing, 10.0) == 0.0
    assert _moved(nothing, Start((), 0.1, 0.0), 10.0) > 1.0


@pytest.mark.parametrize("predictor", [[1.0], [0.5, 0.5], [2.0, -1.0]])
def test_noise_that_forgets_nothing_is_worth_few_samples(predictor):
    memory = Memory((np.zeros(0), np.array(predictor)), (1.0, 0.1))
    assert np.isfinite(memory.samples_each)
    assert memory.samples_each > 1e6
