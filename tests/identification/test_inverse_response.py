"""Zeros in the right half plane: found from the record alone, beside real poles, complex ones and three lags."""

import numpy as np
import pytest
import scipy.signal

from autotuner.core.identification import identify
from autotuner.core.model.process import InverseResponseUnderdamped, frequency_response
from autotuner.core.recording import Recording

QUIET, SWITCHES, HOLD, HELD = 30, 7, 200, 0.5


def relay_on(numerator, denominator, dt, delay=0, sigma=0.0, seed=0):
    """A relay test and a hold, the process moved by SciPy's zero-order hold, `delay` whole samples late."""
    A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(numerator, denominator), dt)
    rng, x, rows, late = np.random.default_rng(seed), np.zeros(len(A)), [], [0.0] * delay
    output, switched, ends, k = 0.0, 0, 20_000, 0
    while k < ends:
        pv = float(C[0] @ x) + sigma * rng.standard_normal()
        if switched > SWITCHES:
            output, ends = HELD, min(ends, k + HOLD)
        elif k >= QUIET:
            wanted = -1.0 if pv > 0.02 + 3.0 * sigma else 2.0 if pv < -0.02 - 3.0 * sigma else output or 2.0
            switched += wanted != output
            output = wanted
        rows.append((k * dt, output, pv))
        late.append(output)
        x = A @ x + B[:, 0] * late.pop(0)
        k += 1
    return Recording(*np.array(rows).T)


def test_a_damped_pair_with_a_zero_is_found_exactly():
    record = relay_on([-0.8, 1.0], [9.0, 2.4, 1.0], 0.1, delay=10)
    model = identify(record).model
    assert isinstance(model, InverseResponseUnderdamped)
    assert list(model.parameters().values()) == pytest.approx([1.0, 9.0, 2.4, 0.8, 1.0], rel=1e-6)


@pytest.mark.one_of(2)
@pytest.mark.parametrize(
    ("a", "sigma"),
    [
        (0.6, 0.005),
        (1.1, 0.0),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((0.6, 0.0), (0.9, 0.0), (0.9, 0.005), (1.1, 0.005))),
    ],
)
def test_three_lags_with_a_zero_are_held_by_a_pair_with_a_zero(a, sigma):
    found = identify(relay_on([-a, 1.0], [1.0, 3.0, 3.0, 1.0], 0.06, sigma=sigma))
    w = np.array([0.2, 0.5, 0.8])  # up to above the frequency at which a loop turns over
    truth = (1.0 - 1j * a * w) / (1.0 + 1j * w) ** 3
    assert "inverse_response" in found.structure
    assert np.max(np.abs(frequency_response(found.model, w) / truth - 1.0)) < 0.06


def test_two_equal_lags_with_a_zero_can_be_asked_for():
    record = relay_on([-0.5, 1.0], [4.0, 4.0, 1.0], 0.05, sigma=0.01)
    found = identify(record, "inverse_response")
    interval = found.estimates["least_squares"].interval95
    assert pytest.approx(4.0, rel=0.05) == found.model.T1 + found.model.T2
    assert interval["T1"][0] < 2.0 < interval["T1"][1]
