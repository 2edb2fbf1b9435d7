"""Low-rank noise and orthogonal columns against dense linear algebra: inverse, determinant, pseudo-inverse."""

import numpy as np
import pytest

from autotuner.core.estimation.linear_least_squares import residual_after, solve_linear
from autotuner.core.estimation.noise.timing_jitter_model import TimingJitterModel

SIGMA = 0.3


@pytest.fixture(params=[0.01, 1.0, 300.0])
def dense(request):
    """Return `B` of one size, weights with samples left out, and the dense `V/s^2` of the samples that count."""
    rng = np.random.default_rng(7)
    columns, weight = request.param * rng.normal(size=(60, 9)), np.where(np.arange(60) % 11 == 0, 0.0, 1.0)
    counting = columns * weight[:, None]
    return columns, weight, np.eye(60) + counting @ counting.T


def test_whitened_values_have_the_inner_products_of_the_inverse_covariance(dense):
    columns, weight, V = dense
    values = np.random.default_rng(8).normal(size=(60, 3))
    white = TimingJitterModel.of(columns, weight, SIGMA).whitened(values)
    np.testing.assert_allclose(white.T @ white, values.T @ np.linalg.inv(V) @ values, rtol=1e-8)


def test_the_determinant_is_that_of_the_covariance(dense):
    columns, weight, V = dense
    assert TimingJitterModel.of(columns, weight, SIGMA).log_determinant == pytest.approx(
        np.linalg.slogdet(V)[1], rel=1e-9
    )


def test_the_likeliest_shifts_are_the_conditional_mean(dense):
    columns, weight, V = dense
    residual = weight * np.random.default_rng(9).normal(size=60)
    expected = (columns * weight[:, None]).T @ np.linalg.solve(V, residual) / SIGMA
    np.testing.assert_allclose(
        TimingJitterModel.of(columns, weight, SIGMA).shifts(residual, weight), expected, rtol=1e-6
    )


@pytest.mark.parametrize("shape", [(40, 1), (40, 5), (6, 6), (4, 7)])
def test_coefficients_and_residual_are_those_of_the_pseudo_inverse(shape):
    rng = np.random.default_rng(10)
    columns, target = rng.normal(size=shape) * np.geomspace(1e-6, 1e6, shape[1]), rng.normal(size=shape[0])
    basis, coefficients = solve_linear(columns, target)
    scaled = columns / np.linalg.norm(columns, axis=0)
    nearest = scaled @ (np.linalg.pinv(scaled) @ target)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    np.testing.assert_allclose(columns @ coefficients, nearest, atol=1e-9)
    np.testing.assert_allclose(residual_after(columns, target), target - nearest, atol=1e-9)


def test_a_column_made_of_others_and_one_of_zeros_get_no_coefficient():
    rng = np.random.default_rng(11)
    one, two, target = rng.normal(size=(3, 30))
    _, coefficients = solve_linear(np.column_stack((one, np.zeros(30), 2.0 * one, two)), target)
    expected = np.linalg.lstsq(np.column_stack((one, two)), target, rcond=None)[0]
    np.testing.assert_allclose(coefficients, [expected[0], 0.0, 0.0, expected[1]], rtol=1e-9)


def test_no_columns_explain_nothing():
    target = np.arange(5.0)
    np.testing.assert_array_equal(residual_after(np.zeros((5, 0)), target), target)
