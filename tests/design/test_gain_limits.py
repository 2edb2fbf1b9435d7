import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design.optimisation.gain_limits import forbidden_gains, largest_gain, largest_gains

PARTS = st.floats(-20.0, 20.0).filter(lambda value: abs(value) > 1e-3)
LIMIT = st.floats(1.05, 3.0)


@given(PARTS, PARTS, LIMIT, LIMIT)
def test_a_gain_is_forbidden_where_a_sensitivity_is_too_large(real, imaginary, Ms, Mt):
    loop = np.array([real + 1j * imaginary])
    lower, upper = forbidden_gains(loop, Ms, Mt)
    k = np.geomspace(1e-4, 1e4, 2000)
    S = 1.0 / np.abs(1.0 + k * loop)
    too_large = (Ms * (1.0 + 1e-9) < S) | (k * np.abs(loop) * S > Mt * (1.0 + 1e-9))
    inside = np.zeros_like(too_large)
    for low, high in zip(lower, upper, strict=True):
        inside |= (k > low * (1.0 - 1e-9)) & (k < high * (1.0 + 1e-9))
    assert np.all(inside[too_large])
    clearly_inside = np.zeros_like(too_large)
    for low, high in zip(lower, upper, strict=True):
        clearly_inside |= (k > low * (1.0 + 1e-6)) & (k < high * (1.0 - 1e-6))
    assert np.all((Ms * (1.0 - 1e-9) < S)[clearly_inside] | (k * np.abs(loop) * S > Mt * (1.0 - 1e-9))[clearly_inside])


def test_pure_delay_by_hand():
    # L = k e^{-jw}: worst where L = -k, so 1/(1 - k) = Ms gives k = 1 - 1/Ms; Mt: k/(1 - k) = Mt gives Mt/(1 + Mt).
    loop = np.exp(-1j * np.linspace(0.01, 20.0, 200_001))
    assert largest_gain(loop, 2.0, 3.0, lambda k: k < 1.0) == pytest.approx(0.5, rel=1e-6)
    assert largest_gain(loop, 4.0, 1.5, lambda k: k < 1.0) == pytest.approx(0.6, rel=1e-6)


def test_a_conditionally_stable_loop_has_a_gap_and_the_highest_stable_one_is_taken():
    # 1/(s - 1) with a delay: below the lowest edge and above the middle one it is unstable, however large Ms may be.
    w = np.geomspace(1e-4, 1e4, 20_001)
    loop = np.exp(-0.1j * w) / (1j * w - 1.0)
    edges = largest_gains(loop, 2.0, 2.5)
    assert len(edges) == 3
    chosen = largest_gain(loop, 2.0, 2.5, lambda k: 1.0 < k < 16.0)
    assert chosen == edges[1]
    assert np.max(1.0 / np.abs(1.0 + chosen * loop)) == pytest.approx(2.0, rel=1e-6)


def test_no_stable_gap_is_none():
    assert largest_gain(np.array([-1.0 + 0.1j]), 1.4, 1.4, lambda _: False) is None


def test_a_loop_that_no_gain_drives_to_its_limits_has_no_edge():
    assert largest_gains(np.array([1.0 - 0.1j]), 1.4, 1.4) == []
