"""Noise with a memory: its whitening against exact covariances, and processes found behind it on known plants."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy

from autotuner.core.estimation.noise.ar_noise import Coloured, Memory, even_runs, memory_of
from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.stepped import SteppedPlant


def coloured(rng, coefficients, size):
    """Noise of an autoregression, its beginning left out; what is new in each sample has the deviation 1."""
    return scipy.signal.lfilter([1.0], [1.0, *(-a for a in coefficients)], rng.standard_normal(size + 500))[500:]


ROWS, DT = 400, 0.25
OUTPUT = np.where(np.arange(ROWS) // 45 % 2 == 0, 2.0, -1.0)
OUTPUT[:40] = 0.0


def moved(plant):
    """The PV of a plant at rest under an output that goes to and fro by itself."""
    device, pv = SteppedPlant(plant), []
    for k, level in enumerate(OUTPUT):
        device.advance(k * DT)
        pv.append(device.pv)
        device.output = float(level)
    return np.array(pv)


def relay_record(plant, sigma, memory, seed):
    """That record under noise that remembers its last sample."""
    noise = math.sqrt(1.0 - memory**2) * coloured(np.random.default_rng(seed), [memory], ROWS)
    return Recording(DT * np.arange(ROWS), OUTPUT, moved(plant) + sigma * noise)


def bounds(plant, names, sigma, memory):
    """The Cramer-Rao bounds for that noise, the offset unknown, from differences of the simulator's own responses."""
    columns = [np.ones(ROWS)]
    for name in names:
        step = 1e-4 * getattr(plant, name)
        up, down = (moved(replace(plant, **{name: getattr(plant, name) + side * step})) for side in (1.0, -1.0))
        columns.append((up - down) / (2.0 * step))
    J = np.column_stack(columns)
    J[1:] = (J[1:] - memory * J[:-1]) / math.sqrt(1.0 - memory**2)
    return sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[1:]


def test_past_samples_are_minus_the_slopes_with_the_coefficients():
    noise, runs = np.random.default_rng(5).standard_normal(40), (slice(0, 15), slice(15, 40))
    before = tuple(np.zeros(j) for j in range(3))

    def innovations(a):
        return Coloured(Memory((*before, np.array(a)), (1.0,) * 4), runs).whitened(noise)

    a, step = np.array([0.6, -0.3, 0.1]), 1e-6
    slopes = [(innovations(a + step * one) - innovations(a)) / step for one in np.eye(3)]
    past = Coloured(Memory((*before, a), (1.0,) * 4), runs).past(noise)
    fully = np.r_[3:15, 18:40]  # the first of a run have predictors of their own
    assert past[fully] == pytest.approx(-np.transpose(slopes)[fully], abs=1e-8)
    assert np.all(past[[0, 15]] == 0.0)


def test_whitened_noise_has_the_covariance_of_white_noise():
    """Of an autoregression of second order, whose autocovariances are known in closed form."""
    a, b, n = 1.2, -0.5, 12
    rho = _correlations(a, b, n)
    V = scipy.linalg.toeplitz(rho)
    left = (1.0, math.sqrt(1.0 - rho[1] ** 2), math.sqrt((1.0 - rho[1] ** 2) * (1.0 - b**2)))
    memory = Memory((np.zeros(0), np.array([rho[1]]), np.array([a, b])), left)
    W = Coloured(memory, (slice(0, n),)).whitened(np.eye(n))
    covariance = W @ V @ W.T
    assert covariance == pytest.approx(left[-1] ** 2 * np.eye(n), abs=1e-12)
    assert memory.samples_each == pytest.approx(1.0 + 2.0 * sum(_correlations(a, b, 400)[1:]), rel=1e-9)


def _correlations(a, b, lags):
    rho = [1.0, a / (1.0 - b)]
    for _ in range(lags - 2):
        rho.append(a * rho[-1] + b * rho[-2])
    return rho


def test_a_hole_begins_a_new_run():
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 8.0, 9.0])
    weight = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    assert even_runs(t, weight) == (slice(0, 3), slice(3, 5), slice(6, 8))
    memory = Memory((np.zeros(0), np.array([0.5])), (1.0, math.sqrt(0.75)))
    whitened = Coloured(memory, even_runs(t, weight)).whitened(np.ones(8) * weight)
    first = math.sqrt(0.75)
    assert whitened == pytest.approx([first, 0.5, 0.5, first, 0.5, 0.0, first, 0.5])


@pytest.mark.parametrize("coefficients", [(0.8,), (1.2, -0.5), (0.4, 0.3, 0.2)])
def test_the_memory_of_long_noise_is_found(coefficients):
    noise = coloured(np.random.default_rng(3), coefficients, 40_000)
    memory = memory_of(noise, np.zeros((noise.size, 0)), (slice(0, noise.size),))
    assert memory.order >= len(coefficients)
    wanted = np.pad(coefficients, (0, memory.order - len(coefficients)))
    assert memory.predictors[-1] == pytest.approx(wanted, abs=0.03)


def test_an_oscillation_is_told_from_noise():
    """Poles at 0.98 and 30 degrees leave `0.98^12` after a period of twelve samples, two real ones nothing."""
    swinging = np.array([2.0 * 0.98 * math.cos(math.pi / 6.0), -(0.98**2)])
    memory = Memory((np.zeros(0), np.zeros(1), swinging), (1.0, 1.0, 1.0))
    assert memory.swings_on == pytest.approx(0.98**12)
    assert Memory((np.zeros(0), np.zeros(1), np.array([1.5, -0.56])), (1.0, 1.0, 1.0)).swings_on == 0.0


def test_white_noise_remembers_nothing():
    noises = [np.random.default_rng(seed).standard_normal(500) for seed in range(40)]
    orders = [memory_of(noise, np.zeros((500, 0)), (slice(0, 500),)).order for noise in noises]
    assert sum(order == 0 for order in orders) >= 36


@pytest.mark.long  # the bound without a memory is in test_least_squares
@pytest.mark.parametrize(
    "plant",
    [
        Fopdt(2.0, 4.0, 4.1),
        *(
            pytest.param(plant, marks=pytest.mark.long)
            for plant in (Fopdt(1.0, 10.0, 2.6), SopdtUnderdamped(1.0, 9.0, 2.4, 1.3))
        ),
    ],
    ids=str,
)
def test_a_process_is_known_as_well_as_it_can_be_behind_the_memory(plant):
    misses, held = [], []
    for seed in range(4):
        found = identify(relay_record(plant, 0.05, 0.9, seed), plant.structure).estimates["least_squares"]
        assert found.evidence["noise_memory"]
        truth = {name: getattr(plant, name) for name in found.model.parameters()}
        misses.append([value - truth[name] for name, value in found.model.parameters().items()])
        held.append([low <= truth[name] <= high for name, (low, high) in found.interval95.items()])
    errors, limits = np.sqrt(np.mean(np.square(misses), axis=0)), bounds(plant, truth, 0.05, 0.9)
    assert np.all(errors < 2.0 * limits), errors / limits
    assert np.mean(held) > 0.85


def test_white_noise_is_left_to_plain_least_squares():
    found = identify(relay_record(Fopdt(1.0, 10.0, 2.6), 0.02, 0.0, 1), "fopdt")
    assert found.estimates["least_squares"].evidence["noise_memory"] == []


def test_a_process_of_another_kind_is_not_taken_for_noise():
    """The residual of a single lag fitted to two has a memory too, and shows the output."""
    found = identify(relay_record(SopdtOverdamped(1.0, 6.0, 5.0, 0.5), 0.003, 0.0, 1), "fopdt")
    assert found.estimates["least_squares"].evidence["noise_memory"] == []
    assert any("the structure lacks" in warning for warning in found.warnings)


def test_the_answer_says_that_the_noise_is_not_white():
    found = identify(relay_record(Fopdt(1.0, 10.0, 2.6), 0.05, 0.9, 2), "fopdt")
    assert any("samples count as one" in warning for warning in found.warnings)
    assert not any("the structure lacks" in warning for warning in found.warnings)
