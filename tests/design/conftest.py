"""Shared by the tests of gains, rules and designs."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from autotuner.core.design import PidGains
from autotuner.core.model.process import Fopdt, Integrating, InverseResponse, SopdtOverdamped, SopdtUnderdamped


@pytest.fixture(scope="session")
def any_gains():
    """A strategy of PID controllers over many decades, of either sign, with and without integral and derivative."""
    gain = st.floats(1e-4, 1e4)
    return st.builds(
        lambda Kp, sign, Ti, ratio, filter_ratio, b: PidGains(
            sign * Kp, Ti, (0.0 if math.isinf(Ti) else Ti) * ratio, filter_ratio, b
        ),
        gain,
        st.sampled_from([-1.0, 1.0]),
        st.one_of(st.just(math.inf), st.floats(1e-2, 1e5)),
        st.one_of(st.just(0.0), st.floats(1e-3, 0.25)),
        st.one_of(st.just(0.0), st.floats(1e-3, 10.0)),
        st.floats(0.0, 1.0),
    )


@pytest.fixture(scope="session")
def stable_models():
    """A strategy of stable and integrating models with a dead time from small to dominant."""
    K = st.one_of(st.floats(0.1, 10.0), st.floats(-10.0, -0.1))
    time = st.floats(0.3, 30.0)
    fraction = st.floats(0.05, 1.0)
    D = st.floats(0.1, 20.0)
    return st.one_of(
        st.builds(Fopdt, K, time, D),
        st.builds(lambda k, T, f, d: SopdtOverdamped(k, T, f * T, d), K, time, fraction, D),
        st.builds(
            lambda k, T, z, d: SopdtUnderdamped(k, T * T, 2.0 * 0.95 * z * T, d), K, time, st.floats(0.1, 1.0), D
        ),
        st.builds(Integrating, K, st.floats(0.0, 10.0), D),
        st.builds(lambda k, T, f, z, d: InverseResponse(k, T, f * T, z * T, d), K, time, fraction, fraction, D),
    )


@pytest.fixture(scope="session")
def inverse_laplace():
    """Invert a Laplace transform at `t` by Euler's summation (Abate and Whitt, ORSA J. Computing 7, 1995).

    It evaluates right of the axis, where nothing under test evaluates.
    """

    def invert(transform, t, terms=400, averaged=12, shift=18.4):
        k = np.arange(terms + averaged + 1)
        s = (shift + 2j * math.pi * k[None, :]) / (2.0 * np.asarray(t)[:, None])
        signs = np.where(k == 0, 0.5, (-1.0) ** k)
        partial = np.cumsum(transform(s).real * signs, axis=1)[:, terms:]
        binomial = np.array([math.comb(averaged, j) for j in range(averaged + 1)]) / 2.0**averaged
        return math.exp(shift / 2.0) / np.asarray(t) * (partial @ binomial)

    return invert
