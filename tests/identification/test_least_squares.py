"""Least squares: exact on noise-free records, at the Cramer-Rao bound with true intervals on noisy ones."""

import math

import numpy as np
import pytest

from autotuner.core.estimation.simulation import response
from autotuner.core.identification import identify
from autotuner.core.model.process import STRUCTURES, second_order
from autotuner.core.recording import Recording
from autotuner_sim.plants import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)

PLANTS = [
    (Fopdt(2.0, 10.0, 1.5), 0.1),
    (Fopdt(-0.3, 3600.0, 100.0), 10.0),
    (Fopdt(5.0, 0.001, 0.01), 2e-4),
    (SopdtOverdamped(1.0, 60.0, 15.0, 5.0), 1.0),
    (SopdtOverdamped(1.0, 10.0, 1.0, 2.0), 0.1),
    (SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), 0.1),
    (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), 0.05),
    (Integrating(0.1, 0.0, 2.0), 0.1),
    (Integrating(0.1, 5.0, 2.0), 0.1),
    (UnstableFopdt(1.0, 10.0, 2.0), 0.05),
    (InverseResponse(1.0, 8.0, 3.0, 2.0, 1.0), 0.1),
]


def values(plant):
    return {name: getattr(plant, name) for name in STRUCTURES[plant.structure].__slots__}


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("plant", "dt"), PLANTS, ids=str)
def test_five_switches_without_noise_give_the_process_itself(record_relay, plant, dt):
    found = identify(record_relay(plant, dt))
    assert found.recommended == "least_squares"
    assert found.structure == plant.structure
    assert found.model.parameters() == pytest.approx(values(plant), rel=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_one_sided_relay_with_noise_and_a_coarse_sensor(record_relay, seed):
    record = record_relay(
        Fopdt(2.0, 10.0, 1.5), 0.1, switches=7, low=0.0, high=15.0, reference=10.0, hysteresis=0.15, quiet=50,
        sigma=0.05, quantum=0.1, seed=seed,
    )  # fmt: skip
    found = identify(record)
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.01)
    assert all(math.isfinite(e) for e in found.estimates["least_squares"].standard_error.values())


def cramer_rao(plant, record, sigma):
    """Standard deviations that no unbiased estimator beats, offset unknown."""
    return bound_of(STRUCTURES[plant.structure], values(plant), record, sigma)


def bound_of(kind, base, record, sigma):
    """The bound for the model `kind(**base)`: slopes by central differences."""
    t, u = record.t - record.t[0], record.output - record.output[0]
    columns = [np.ones_like(t)]
    for name, value in base.items():
        up, down = (response(kind(**{**base, name: value * (1.0 + s)}), t, u) for s in (1e-6, -1e-6))
        columns.append((up - down) / (2e-6 * value))
    J = np.column_stack(columns)
    scale = np.linalg.norm(J, axis=0)
    bound = np.sqrt(np.diag(np.linalg.inv((J / scale).T @ (J / scale)))) / scale
    return dict(zip(base, sigma * bound[1:], strict=True))


NOISY = [
    (Fopdt(1.65, 20.0, 10.0), 0.35, 0.05),
    pytest.param(SopdtOverdamped(1.0, 10.0, 1.0, 2.0), 0.1, 0.01, marks=pytest.mark.long),
    pytest.param(SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), 0.1, 0.02, marks=pytest.mark.long),
]


@pytest.mark.parametrize(("plant", "dt", "sigma"), NOISY, ids=str)
def test_errors_reach_the_cramer_rao_bound_and_intervals_hold_the_truth(record_relay, plant, dt, sigma):
    misses, inside = [], []
    for seed in range(40):
        record = record_relay(plant, dt, hysteresis=3.0 * sigma, sigma=sigma, seed=seed)
        estimate = identify(record, plant.structure).estimates["least_squares"]
        bound = cramer_rao(plant, record, sigma)
        found = estimate.model.parameters()
        misses.append([(found[name] - truth) / bound[name] for name, truth in values(plant).items()])
        inside.append([low <= values(plant)[name] <= high for name, (low, high) in estimate.interval95.items()])
        assert estimate.standard_error == pytest.approx(bound, rel=0.2)
    # 40 seeds: the root mean square of a standard normal lies within 1 +- 0.35, three of its standard errors.
    assert np.all(np.sqrt(np.mean(np.square(misses), axis=0)) < 1.35)
    assert np.mean(inside) > 0.90


@pytest.fixture(scope="module")
def close_lags(record_relay):
    """Return a plant of two close lags, with records under a noise of 0.01 and the estimates from each."""
    plant = SopdtOverdamped(1.0, 5.2, 5.0, 3.0)
    records = [record_relay(plant, 0.1, sigma=0.01, hysteresis=0.03, seed=seed) for seed in range(12)]
    return plant, records, [identify(record, plant.structure).estimates["least_squares"] for record in records]


def test_close_lags_are_reported_as_close(close_lags):
    plant, _, estimates = close_lags
    for name in ("T1", "T2", "K", "D"):
        inside = [e.interval95[name][0] <= getattr(plant, name) <= e.interval95[name][1] for e in estimates]
        assert sum(inside) >= 10, name
    low, high = estimates[0].interval95["T1"]
    assert high - low > 0.5


def test_close_lags_are_known_by_their_sum_and_product(close_lags):
    """To the Cramer-Rao bound of (K, m, n, D), where the lags themselves have no covariance."""
    pair = {"K": 1.0, "m": 5.2 * 5.0, "n": 10.2, "D": 3.0}
    known = 0
    for record, estimate in zip(*close_lags[1:], strict=True):
        if estimate.covariance is not None:
            assert estimate.pair_covariance is None
            continue
        known += 1
        bound = bound_of(second_order, pair, record, 0.01)
        found = dict(zip(pair, np.sqrt(np.diag(estimate.pair_covariance)), strict=True))
        assert found == pytest.approx(bound, rel=0.2)
        T1, T2 = estimate.model.T1, estimate.model.T2
        misses = [estimate.model.K - 1.0, T1 * T2 - pair["m"], T1 + T2 - pair["n"], estimate.model.D - 3.0]
        assert np.all(np.abs(misses) < 4.0 * np.array(list(bound.values())))
    assert known >= 6


def test_samples_need_not_be_equally_spaced():
    rng = np.random.default_rng(5)
    t = np.sort(rng.uniform(0.0, 120.0, 400))
    output = np.where(t > 10.0, np.where(t % 40.0 > 20.0, 2.0, -1.0), 0.0)
    plant = STRUCTURES["fopdt"](1.5, 6.0, 2.345)
    found = identify(Recording(t, output, 7.0 + response(plant, t, output)))
    assert found.model.parameters() == pytest.approx(plant.parameters(), rel=1e-7)


def test_a_record_may_begin_in_the_middle_of_the_motion(record_relay):
    record = record_relay(Fopdt(2.0, 10.0, 1.5), 0.1, switches=9)
    late = record.window(float(record.t[90]), float(record.t[-1]))
    assert late.output[0] != 0.0
    assert identify(late).model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.02)


def test_a_symmetric_relay_from_the_very_first_sample(record_relay):
    found = identify(record_relay(Fopdt(1.0, 10.0, 2.0), 0.05, low=-1.0, high=1.0, quiet=0, switches=6))
    assert found.model.parameters() == pytest.approx({"K": 1.0, "T": 10.0, "D": 2.0}, rel=1e-6)


def test_spikes_are_left_out_and_counted(record_relay):
    record = record_relay(Fopdt(2.0, 10.0, 1.5), 0.1, switches=7, hysteresis=0.1, sigma=0.03, seed=2)
    pv = record.pv.copy()
    pv[[60, 100, 101, 140]] += [40.0, -25.0, -25.0, 60.0]
    found = identify(Recording(record.t, record.output, pv))
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.03)
    assert any("4 wild readings were left out" in warning for warning in found.warnings)


@pytest.mark.long  # five switches of an integrator show it
def test_an_integrator_off_balance_drifts_and_is_still_found(record):
    plant = Integrating(0.2, 0.0, 3.0)
    steps = {0: 0.0, 100: 1.0, 200: -1.0, 300: 1.5}
    level = {"now": 0.0}

    def output_at(k, _):
        level["now"] = steps.get(k, level["now"])
        return level["now"]

    resting = record(plant, 0.2, output_at, 450)
    drifting = Recording(resting.t, resting.output, resting.pv + 0.05 * resting.t)
    found = identify(drifting)
    assert found.structure == "integrating"
    assert found.model.parameters() == pytest.approx({"K": 0.2, "T": 0.0, "D": 3.0}, rel=1e-6, abs=1e-9)


def test_a_known_gain_is_used_as_it_is(record_relay):
    record = record_relay(Fopdt(2.0, 10.0, 1.5), 0.1, sigma=0.02, hysteresis=0.06)
    found = identify(record, known_gain=2.0)
    assert found.model.K == 2.0
    assert found.estimates["least_squares"].standard_error["K"] == 0.0
    assert pytest.approx(10.0, rel=0.02) == found.model.T


@pytest.mark.parametrize(
    ("plant", "output"),
    [
        (Fopdt(2.0, 10.0, 3.0), lambda k: float(k > 40)),
        (SopdtOverdamped(2.0, 10.0, 5.0, 3.0), lambda k: float(k > 40)),
        (SopdtUnderdamped(2.0, 25.0, 3.0, 3.0), lambda k: float(40 < k < 300)),
    ],
    ids=["fopdt", "overdamped", "underdamped"],
)
def test_steps(record, plant, output):
    found = identify(record(plant, 0.2, lambda k, _: output(k), 500))
    assert found.structure == plant.structure
    assert found.model.parameters() == pytest.approx(values(plant), rel=1e-6)


def test_random_binary_sequence(record):
    sequence = np.repeat(np.random.default_rng(1).integers(0, 2, 60), 10).astype(float)
    plant = SopdtOverdamped(2.0, 3.0, 1.0, 0.75)
    found = identify(record(plant, 0.1, lambda k, _: sequence[k], 600, sigma=0.02, seed=1))
    assert found.limit_cycle is None
    assert found.structure == plant.structure
    assert found.model.parameters() == pytest.approx(values(plant), rel=0.1)


def test_closed_loop_with_set_point_changes(record):
    integral = {"sum": 0.0}

    def controller(k, pv):
        error = (1.0 if k > 50 else 0.0) + (1.0 if k > 300 else 0.0) - pv
        integral["sum"] += error * 0.1
        return 1.0 * error + 0.2 * integral["sum"]

    found = identify(record(Fopdt(1.5, 6.0, 1.25), 0.1, controller, 600, sigma=0.005, seed=1))
    assert found.structure == "fopdt"
    assert found.model.parameters() == pytest.approx({"K": 1.5, "T": 6.0, "D": 1.25}, rel=0.03)
