"""A closed loop offers the inverse of its controller as a model; it is recognised, and a process is not."""

import numpy as np
import pytest

from autotuner.core.identification.controller_inverse import controller_of, is_inverse
from autotuner.core.model.process import Fopdt
from autotuner.core.recording import Recording

K, T, DELAY, KP, TI = 2.0, 20.0, 3, 0.9, 15.0
W = 0.15


def loop(moves, n=900, sigma=0.1, load=0.02, seed=4, wave=0.0):
    """A lag under a PI controller of 1 s; a load drives it, random or a wave, and the set point where it moves."""
    random = np.random.default_rng(seed)
    u, pv, sp = np.zeros(n), np.zeros(n), np.zeros(n)
    if moves:
        sp = np.repeat(random.uniform(-5.0, 5.0, n // 60), 60)
    x = d = integral = 0.0
    for k in range(n):
        pv[k] = x + sigma * random.standard_normal()
        e = sp[k] - pv[k]
        integral += e / TI
        u[k] = KP * (e + integral)
        d = wave * np.sin(W * k) if wave else d + load * random.standard_normal()
        x += (K * (u[max(k - DELAY, 0)] + d) - x) / T
    return Recording(np.arange(float(n)), 40.0 + u, 60.0 + pv, 60.0 + sp)


@pytest.mark.parametrize("moves", [True, False])
def test_the_controller_is_found(moves):
    found = controller_of(loop(moves))
    w = np.array([0.05, 0.2])
    np.testing.assert_allclose(found.coefficients[:2], [KP * (1.0 + 1.0 / TI), -KP], rtol=1e-6)
    # 1/(jw) of the textbook and the sum of the samples differ by half a sample.
    textbook = KP * (1.0 + 1.0 / (1j * w * TI))
    here = type(found)(found.coefficients, found.interval_s, w, np.ones(2)).response()
    np.testing.assert_allclose(here, textbook, rtol=0.05)


@pytest.mark.parametrize(("moves", "sign"), [(True, 1), (False, 1), (True, -1), (False, -1)])
def test_a_controller_shows_the_sign_of_what_it_controls(moves, sign):
    """The same loop with the PV upside down has a process and a controller of the other sign."""
    record = loop(moves)
    turned = Recording(record.t, record.output, sign * record.pv, sign * record.set_point)
    assert controller_of(turned).sign_of_process == sign


def test_a_controller_without_integral_action_shows_no_sign():
    found = controller_of(loop(moves=True))
    a = float(found.coefficients[0])
    assert type(found)(np.array([a, -1.01 * a, 0.0]), 1.0, np.ones(1), np.ones(1)).sign_of_process == 0


def test_its_inverse_is_recognised_and_the_process_is_not():
    controller = controller_of(loop(moves=False, wave=2.0))
    assert not is_inverse(Fopdt(K, T, float(DELAY)), controller)
    assert not is_inverse(Fopdt(-K, T, float(DELAY)), controller)
    # -1/C = -(1/Kp) Ti s/(Ti s + 1): at the frequency of the load a gain and a phase, which a dead time gives.
    inverse = -1.0 / (KP * (1.0 + 1.0 / (1j * W * TI)))
    delay = (-np.angle(inverse)) % (2.0 * np.pi) / W
    assert is_inverse(Fopdt(abs(inverse), 1e-3, delay), controller)
    assert not is_inverse(Fopdt(1.5 * abs(inverse), 1e-3, delay), controller)


def test_a_zero_beside_the_process_may_make_it_the_inverse():
    controller = controller_of(loop(moves=False))
    # -1/C = -(1/Kp) Ti s/(Ti s + 1) = k (1 - Z s)/(Ti s + 1) with a gain of almost nothing and a zero beyond all.
    zero_s = 1e6
    small = Fopdt(TI / KP / zero_s, TI, 0.0)
    assert is_inverse(small, controller, zero_s)
    assert not is_inverse(small, controller)
    assert not is_inverse(Fopdt(-small.K, TI, 0.0), controller, zero_s)


def test_no_controller_no_inverse():
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(30.0, 50.0, 30), 20)
    pv = 2.0 * np.convolve(u, np.exp(-np.arange(60) / 10.0) / 10.0)[: u.size]
    assert controller_of(Recording(np.arange(float(u.size)), u, pv)) is None
    assert not is_inverse(Fopdt(-1.0, 1.0, 0.0), None)
