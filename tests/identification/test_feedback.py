"""Closed loops: who moved the output, the sign that follows, and that the controller's inverse is not taken for it."""

import numpy as np
import pytest

from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner.core.signals.feedback import process_sign
from autotuner_sim.plants import Fopdt


def closed_loop(record, plant, *, sigma, Kp=0.5, Ki=0.02, seed=0, set_point=lambda _: 0.0, samples=600):
    integral = {"sum": 0.0}

    def controller(k, pv):
        error = set_point(k) - pv
        integral["sum"] += Ki * error
        return Kp * error + integral["sum"]

    return record(plant, 1.0, controller, samples, sigma=sigma, seed=seed)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_controller_tells_the_sign_of_the_gain(record, sign):
    plant = Fopdt(sign * 1.5, 20.0, 3.0)
    assert process_sign(closed_loop(record, plant, sigma=0.1, Kp=sign * 0.5, Ki=sign * 0.02)) == sign


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_said_without_a_controller(record, record_relay, seed):
    rng = np.random.default_rng(seed)
    steps, walk = np.repeat(rng.integers(0, 2, 60), 10).astype(float), np.cumsum(rng.standard_normal(600)) * 0.02
    smooth = np.sin(0.03 * np.arange(600.0)) + np.sin(0.051 * np.arange(600.0) + seed)
    plant = Fopdt(1.5, 20.0, 3.0)
    for output in (steps, walk, smooth):
        driven = record(plant, 1.0, lambda k, _, output=output: output[k], 600, sigma=0.1, seed=seed)
        assert process_sign(driven) == 0
    assert process_sign(record_relay(plant, 1.0, sigma=0.05, hysteresis=0.15, seed=seed)) == 0


def test_a_noise_free_smooth_record_says_nothing():
    t = np.arange(300.0)
    assert process_sign(Recording(t, np.sin(0.1 * t), np.sin(0.1 * t - 1.0))) == 0


@pytest.mark.parametrize("seed", range(3))
def test_the_controllers_inverse_is_not_taken_for_the_process(record, seed):
    start = closed_loop(
        record, Fopdt(1.5, 20.0, 3.0), sigma=0.02, Ki=0.0, seed=seed, set_point=lambda k: float(k >= 40), samples=300
    )
    found = identify(start)
    assert found.model is None or found.model.K > 0.0
    assert any("controller" in warning for warning in found.warnings) or found.model is None


@pytest.mark.long  # other controllers are in the tests above
def test_a_proportional_controller_alone_is_not_turned_into_a_process():
    """`u = Kp (r - pv)` to the last digit: its inverse fits, with a negative gain or as a very fast unstable lag."""
    rng = np.random.default_rng(1)
    pv = 28.0 + 0.02 * np.cumsum(0.1 + rng.standard_normal(110)) + 0.01 * rng.standard_normal(110)
    found = identify(Recording(np.arange(110.0), 30.0 - pv, pv))
    assert found.model is None or (found.model.K > 0.0 and found.structure != "unstable_fopdt")


@pytest.mark.parametrize("window", [(20.0, 100.0), (22.0, 120.0), (15.0, 160.0)])
def test_the_answer_of_a_closed_loop_is_not_taken_for_a_motion_that_was_there_before(record, window):
    """A pair of poles with a long dead time, its first samples left out, repeats the answer of the loop by itself."""
    loop = closed_loop(
        record, Fopdt(2.0, 20.0, 4.0), sigma=0.05, Kp=1.2, Ki=0.06, set_point=lambda k: 10.0 * (k >= 25), samples=200
    )
    found = identify(loop.window(*window))
    assert found.structure == "fopdt"
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 20.0, "D": 4.0}, rel=0.06)


def test_an_integrator_that_begins_in_motion_is_not_taken_for_its_opposite_half_a_period_later():
    t = np.arange(2000.0)
    output = np.where(np.arange(2000) // 100 % 2, 1.0, -1.0)
    pv = 0.01 * np.concatenate(([0.0], np.cumsum(output)[:-1])) + 0.05 * np.random.default_rng(1).standard_normal(2000)
    found = identify(Recording(t, output, pv), "integrating")
    assert found.model.parameters()["K"] == pytest.approx(0.01, rel=0.02)
    assert found.model.D < 5.0


@pytest.mark.parametrize("gain", [2.0, -2.0])
def test_a_relay_shows_the_sign_of_the_gain(gain):
    """A lag of 10 s with 2 s of dead time under a relay, by Euler's method; its output passes no noise on."""
    direct, h = np.sign(gain), 0.01
    x, late, u, output, pv = 0.0, [0.0] * 200, 0.0, [], []
    for k in range(20000):
        if k % 100 == 0:
            error = direct * x
            u = 0.0 if k < 2000 else -1.0 if error > 0.1 else 1.0 if error < -0.1 or u == 0.0 else u
            output.append(u)
            pv.append(x + 1e-3 * np.sin(7.0 * k))
        late.append(u)
        x += h / 10.0 * (gain * late[-201] - x)
    times = np.arange(len(pv), dtype=float)
    assert process_sign(Recording(times, np.array(output), np.array(pv))) == direct
