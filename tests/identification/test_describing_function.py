"""The describing function: the thesis's own numbers, round trips, hysteresis, its known bias, what it refuses."""

import cmath
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from autotuner.core.identification.limit_cycle import describing_function as df
from autotuner.errors import InputError


def oscillation(K, m, n, D, h, phi):
    """Amplitude and period at which `N G = -1` for a relay that lags by `phi`, by root finding on the phase of G."""

    def behind(w):
        return w * D + cmath.phase(complex(1.0 - m * w * w, n * w))

    w = brentq(lambda w: behind(w) - (math.pi - phi), 1e-12, math.pi / D, xtol=1e-300, rtol=1e-14)
    return 4.0 * h * abs(K / complex(1.0 - m * w * w, n * w)) / math.pi, 2.0 * math.pi / w


# Thesis tables 5.2 to 5.7, offline row: amplitude and period as stated there; the printed digits are truncated.
@pytest.mark.parametrize(
    ("make", "printed"),
    [
        (lambda: df.fopdt(1.65, 1.0, 0.6491, 33.272), {"T": "16.30", "D": "9.981"}),
        (lambda: df.fopdt(8.1, 1.0, 3.441, 17.057), {"T": "7.67", "D": "5.187"}),
        (lambda: df.sopdt(1.0, 4.0, 1.0, 0.3129, 19.117), {"T1": "10.1189", "T2": "1.8578"}),
        (lambda: df.sopdt(1.5, 5.0, 1.0, 0.6194, 24.674), {"T1": "7.8231", "T2": "3.7532"}),
        (lambda: df.sopdt(1.0, 3.0, 1.0, 2.536, 7.861), {"m": "0.9869", "n": "0.4252"}),
    ],
)
def test_numbers_of_the_thesis(make, printed):
    values = make().parameters()
    for name, digits in printed.items():
        decimals = len(digits.partition(".")[2])
        assert math.floor(values[name] * 10**decimals) / 10**decimals == float(digits), name


def test_fopdt_by_hand():
    # |N K| = sqrt 2 at w = 1 rad/s: T = 1 s, and atan 1 = pi/4 leaves D = 3 pi/4.
    model = df.fopdt(math.sqrt(2.0), math.pi / 4.0, 1.0, 2.0 * math.pi)
    assert pytest.approx(1.0, rel=1e-14) == model.T
    assert pytest.approx(0.75 * math.pi, rel=1e-14) == model.D


def test_hysteresis_turns_the_describing_function():
    N, w = df.ultimate_point(1.0, 2.0, 4.0, eps=1.0)
    assert abs(N) == pytest.approx(2.0 / math.pi)
    assert math.atan2(N.imag, N.real) == pytest.approx(-math.pi / 6.0)
    assert w == pytest.approx(math.pi / 2.0)


lags, delays, angles = st.floats(0.2, 20.0), st.floats(0.2, 20.0), st.floats(0.0, 0.7)


@given(K=st.floats(0.5, 15.0), T=lags, D=delays, phi=angles, h=st.floats(0.1, 10.0))
def test_fopdt_is_found_again_from_its_own_harmonic_balance(K, T, D, phi, h):
    A, Pu = oscillation(K, 0.0, T, D, h, phi)
    found = df.fopdt(K, h, A, Pu, A * math.sin(phi))
    # Where the lag hardly attenuates, T hangs on the last digits of A.
    assert pytest.approx(T, rel=1e-6, abs=1e-6 * Pu) == found.T
    assert pytest.approx(D, rel=1e-6) == found.D


@given(K=st.floats(0.5, 15.0), T=lags, damping=st.floats(0.25, 3.0), D=delays, phi=angles)
def test_second_order_is_found_again_from_its_own_harmonic_balance(K, T, damping, D, phi):
    m, n = T * T, 2.0 * damping * T
    A, Pu = oscillation(K, m, n, D, 1.0, phi)
    _, found_n, found_m = df.sopdt(K, D, 1.0, A, Pu, A * math.sin(phi)).rational().a
    assert found_n == pytest.approx(n, rel=1e-6, abs=1e-6 * Pu)
    assert found_m == pytest.approx(m, rel=1e-6, abs=1e-6 * Pu**2)


# Exact cycles of FOPDT under an ideal relay, percent: D/T, then the errors of Ku, Pu, T and D (K known).
KNOWN_BIAS = [
    (0.01, -18.9, -0.1, -18.9, 0.0),
    (0.1, -18.2, -0.8, -18.9, 0.0),
    (0.5, -15.0, -2.7, -18.5, -0.2),
    (1.0, -10.9, -3.8, -17.1, -0.9),
    (2.0, -3.1, -4.4, -9.8, -3.3),
    (5.0, 13.2, -3.9, 45.0, -10.7),
    (10.0, 22.4, -2.6, 168.0, -15.8),
    (50.0, 27.1, -0.6, 1170.0, -20.2),
]


@pytest.mark.parametrize(("d", "Ku", "Pu", "T", "D"), KNOWN_BIAS)
def test_bias_on_exact_cycles(d, Ku, Pu, T, D):
    A, period = -math.expm1(-d), 2.0 * math.log(2.0 * math.exp(d) - 1.0)
    w = brentq(lambda w: w * d + math.atan(w) - math.pi, 1e-9, math.pi / d)
    true_gain, true_period = math.hypot(1.0, w), 2.0 * math.pi / w
    found = df.fopdt(1.0, 1.0, A, period)
    errors = (4.0 / (math.pi * A) / true_gain, period / true_period, found.T, found.D / d)
    for error, known in zip(errors, (Ku, Pu, T, D), strict=True):
        # The known figures are printed to 0.1, the large ones to 1 or 10.
        assert 100.0 * (error - 1.0) == pytest.approx(known, abs=0.1 if abs(known) < 40.0 else 0.006 * abs(known))


def test_negative_gain_is_kept():
    assert df.fopdt(-2.0, 1.0, 0.5, 10.0).K == -2.0
    assert df.fopdt(-2.0, 1.0, 0.5, 10.0).T == df.fopdt(2.0, 1.0, 0.5, 10.0).T


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: df.fopdt(1.0, 0.0, 1.0, 1.0), "h"),
        (lambda: df.fopdt(1.0, 1.0, -1.0, 1.0), "A"),
        (lambda: df.fopdt(1.0, 1.0, 0.1, math.inf), "Pu"),
        (lambda: df.fopdt(1.0, 1.0, 0.1, 1.0, eps=0.1), "eps"),
        (lambda: df.fopdt(0.5, 1.0, 1.0, 1.0), "K"),
        (lambda: df.sopdt(1.0, -1.0, 1.0, 0.3, 19.0), "D"),
        (lambda: df.sopdt(1.0, 15.0, 1.0, 0.3, 19.0), "D"),
    ],
)
def test_what_no_process_can_have_produced_is_refused_with_a_remedy(call, field):
    with pytest.raises(InputError) as error:
        call()
    assert error.value.field == field
    assert error.value.remedy
