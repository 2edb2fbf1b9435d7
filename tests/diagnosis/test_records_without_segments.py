"""Effects on plain records of output and PV, as a historian keeps them.

Every record is integrated here, in small steps of Euler's method, and by nothing of the product or its simulator.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose

PARTS = 40
"""Steps of Euler's method in a sample interval."""
K, T1, T2, DELAY = 2.0, 10.0, 4.0, 3.0


def levels(rng, n, shortest, longest, swing=10.0):
    """Return an output that rests at 40 and then moves to random levels and back."""
    result = [40.0] * 20
    way = 1.0
    while len(result) < n:
        way = -way
        result += [40.0 + way * rng.uniform(0.3, 1.0) * swing] * int(rng.integers(shortest, longest))
    return np.array(result[:n])


def integrated(output, position, load=lambda _t: 0.0, lags=(T1, T2), gain=K):
    """Return the PV of lags in a row behind a dead time, at the samples.

    Parameters
    ----------
    output : array
        The output at each second.
    position : callable
        From the output and the time to where the actuator is; called at each small step.
    load : callable
        What is added at the input of the process, by time.
    """
    h = 1.0 / PARTS
    x, pv, entered = [0.0] * len(lags), [], [0.0] * int(DELAY / h)
    for k, u in enumerate(output.tolist()):
        pv.append(60.0 + x[-1])
        for j in range(PARTS):
            t = k + j * h
            entered.append(position(u, t) - 40.0)
            source = gain * (entered[-1 - int(DELAY / h)] + load(t))
            for i, lag in enumerate(lags):
                source, x[i] = x[i], x[i] + h / lag * (source - x[i])
    return np.array(pv)


def straight(u, _t):
    return u


def recorded(output, pv, sigma=0.05, seed=1):
    noise = np.random.default_rng(seed).normal(0.0, sigma, pv.size)
    return Recording(np.arange(output.size, dtype=float), output, pv + noise)


class Updated:
    """An actuator that takes over its output at some moments only."""

    def __init__(self, moments):
        self.moments, self.at = list(moments), 40.0

    def __call__(self, u, t):
        while self.moments and self.moments[0] <= t:
            self.moments.pop(0)
            self.at = u
        return self.at


@pytest.mark.parametrize("seed", [3, 4])
def test_an_actuator_that_is_updated_at_uneven_times_is_named(seed):
    rng = np.random.default_rng(seed)
    output = levels(rng, 700, 15, 45)
    moments = np.cumsum(rng.uniform(2.0, 12.0, 300))
    answer = diagnose(recorded(output, integrated(output, Updated(moments))))
    assert [e.name for e in answer.effects] == ["actuator_hold"]
    assert answer.error["fitted"].after < 1.3 * 0.05 < answer.error["fitted"].before / 4.0
