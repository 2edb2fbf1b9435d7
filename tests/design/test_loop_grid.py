"""Time responses of the grids against closed forms and against an inversion of the Laplace transform elsewhere."""

import math

import numpy as np
import pytest

from autotuner.core.design import PidGains, apply_rule, tune
from autotuner.core.design.optimisation.loop_grid import cosine_matrix, integral_weights, loop_grid
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)

LOOPS = [
    (Fopdt(2.0, 10.0, 2.0), PidGains(1.2, 6.0, 0.9, 0.1)),
    (Fopdt(1.0, 0.2, 5.0), PidGains(0.3, 2.0)),
    (SopdtOverdamped(2.0, 10.0, 4.0, 2.0), PidGains(1.0, 10.0, 3.0, 0.4)),
    (SopdtUnderdamped(1.0, 1.0, 0.5, 1.0), PidGains(0.11, 0.41, 3.0, 0.3)),
    (Integrating(0.1, 1.0, 2.0), PidGains(1.3, 16.0, 1.5, 0.2)),
    (InverseResponse(1.0, 5.0, 2.0, 1.0, 1.0), PidGains(0.9, 5.0, 1.0, 0.1)),
    (UnstableFopdt(1.0, 10.0, 1.0), PidGains(5.0, 20.0, 0.4, 0.05)),
]


def test_cosine_matrix_inverts_what_is_known_in_closed_form():
    w, t = np.geomspace(1e-4, 1e4, 800), np.geomspace(0.01, 30.0, 60)
    matrix = cosine_matrix(w, t)
    np.testing.assert_allclose(matrix @ (1.0 / (1.0 + 1j * w) ** 2).real, t * np.exp(-t), atol=2e-4)
    damped = np.exp(-0.2 * t) * np.sin(math.sqrt(0.96) * t) / math.sqrt(0.96)
    np.testing.assert_allclose(matrix @ (1.0 / (1.0 + 0.4j * w - w * w)).real, damped, atol=2e-3)


def test_cosine_matrix_is_exact_for_a_straight_spectrum():
    # Re Y = 1 - w up to w = 1, 0 beyond: y = (2/pi) (1 - cos t)/t^2.
    t = np.array([0.1, 1.0, 10.0])
    matrix = cosine_matrix(np.array([1e-9, 0.25, 1.0, 2.0]), t)
    expected = 2.0 / math.pi * (1.0 - np.cos(t)) / t**2
    np.testing.assert_allclose(matrix @ np.array([1.0, 0.75, 0.0, 0.0]), expected, rtol=1e-6)


def test_integral_weights_are_the_trapezoidal_rule():
    t = np.array([1.0, 2.0, 4.0])
    assert integral_weights(t) @ np.array([2.0, 2.0, 0.0]) == pytest.approx(1.0 + 2.0 + 2.0)


def controller(s, gains):
    return gains.Kp * (1.0 + 1.0 / (s * gains.Ti) + s * gains.Td) / (1.0 + s * gains.Tf + (s * gains.Tf) ** 2 / 2.0)


def undelayed(s, model):
    r = model.rational()
    return (r.b[0] + r.b[1] * s) / (r.a[0] + r.a[1] * s + r.a[2] * s * s)


@pytest.mark.parametrize(("model", "gains"), LOOPS, ids=lambda value: getattr(value, "structure", ""))
def test_load_error_agrees_with_an_inversion_elsewhere(inverse_laplace, model, gains):
    grid = loop_grid(model)
    some = np.flatnonzero((grid.t > 0.05 * model.D) & (grid.t < 30.0 * (model.D + 1.0)))[::5]

    def transform(s):
        G = undelayed(s, model)
        return G / (s * (1.0 + controller(s, gains) * G * np.exp(-s * model.D)))

    expected = inverse_laplace(transform, grid.t[some])
    np.testing.assert_allclose(grid.load_error(gains)[some], expected, atol=3e-3 * np.max(np.abs(expected)))


@pytest.mark.parametrize(("model", "gains"), LOOPS, ids=lambda value: getattr(value, "structure", ""))
def test_set_point_error_agrees_with_an_inversion_elsewhere(inverse_laplace, model, gains):
    grid = loop_grid(model)
    some = np.flatnonzero((grid.t > 0.05 * model.D) & (grid.t < 30.0 * (model.D + 1.0)))[::5]
    b = 0.4

    def transform(s):
        G = undelayed(s, model)
        closed = G * gains.Kp * (b + 1.0 / (s * gains.Ti)) / (1.0 + controller(s, gains) * G * np.exp(-s * model.D))
        return (1.0 - closed) / s

    e0, p = grid.set_point_error(gains)
    np.testing.assert_allclose((e0 - b * p)[some], inverse_laplace(transform, grid.t[some]), atol=6e-3)


@pytest.mark.parametrize(("model", "gains"), LOOPS, ids=lambda value: getattr(value, "structure", ""))
def test_integral_of_the_load_error_is_the_integral_time_over_the_gain(model, gains):
    grid = loop_grid(model)
    assert grid.weights @ grid.load_error(gains) == pytest.approx(gains.Ti / gains.Kp, rel=2e-3)


def test_set_point_weight_takes_the_largest_without_much_overshoot():
    model = SopdtOverdamped(1.0, 100.0, 100.0, 1.0)
    gains = tune(model).gains
    grid = loop_grid(model)
    e0, p = grid.set_point_error(gains)
    assert 0.0 < gains.b < 1.0
    assert np.max(gains.b * p - e0) <= 0.05
    assert np.max((gains.b + 0.05) * p - e0) > 0.05
    assert grid.overshoot(gains) == pytest.approx(np.max(gains.b * p - e0))


def test_a_calm_loop_keeps_its_full_weight():
    model = Fopdt(1.0, 1.0, 1.0)
    gains = apply_rule("simc_pi", model).gains
    assert loop_grid(model).set_point_weight(gains) == 1.0
