"""Measured disturbances: told apart from the answer to the output, on records of the independent simulator."""

import numpy as np
import pytest

from autotuner.core.identification import identify, simulate_fit, without_disturbances
from autotuner.core.recording import Recording
from autotuner.errors import InputError
from autotuner_sim.plants import Fopdt, Integrating, SopdtOverdamped
from autotuner_sim.stepped import SteppedPlant

DT, ROWS = 0.5, 600


def moved_by(plant, held, dt=DT):
    """The PV of a plant at rest under a held input."""
    device, pv = SteppedPlant(plant), []
    for k, value in enumerate(held):
        device.advance(k * dt)
        pv.append(device.pv)
        device.output = float(value)
    return np.array(pv)


def record(plant, other, sigma=0.0, seed=0):
    """Output and disturbance move at random by themselves; their answers add up."""
    rng = np.random.default_rng(7)
    output, load = (np.repeat(rng.choice([-1.0, 0.0, 2.0], ROWS // n), n) for n in (40, 50))
    output[:20] = load[:30] = 0.0
    pv = moved_by(plant, output) + moved_by(other, load) + sigma * np.random.default_rng(seed).standard_normal(ROWS)
    return Recording(DT * np.arange(ROWS), output, pv, extra={"load": load, "room": np.full(ROWS, 21.0)})


PLANTS = [
    (Fopdt(2.0, 10.0, 1.7), Fopdt(-0.8, 10.0, 6.3)),
    (SopdtOverdamped(1.0, 12.0, 4.0, 2.2), SopdtOverdamped(0.5, 12.0, 4.0, 0.0)),
    (Integrating(0.1, 5.0, 2.0), Integrating(0.05, 5.0, 9.4)),
]


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("plant", "other"), PLANTS, ids=str)
def test_without_noise_both_ways_are_found_exactly(plant, other):
    found = identify(record(plant, other), disturbances=["load"])
    truth = {name: getattr(plant, name) for name in found.model.parameters()}
    assert found.structure == plant.structure
    assert found.model.parameters() == pytest.approx(truth, rel=1e-5)
    (load,) = found.disturbances
    assert (load.name, load.gain, load.D) == (
        "load",
        pytest.approx(other.K, rel=1e-5),
        pytest.approx(other.D, abs=1e-4),
    )


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_with_noise_the_errors_are_true_and_the_process_is_not_blamed(seed):
    plant, other = PLANTS[0]
    noisy = record(plant, other, sigma=0.1, seed=seed)
    named = identify(noisy, "fopdt", disturbances=["load"])
    (load,) = named.disturbances
    assert abs(load.gain - other.K) < 4.0 * load.gain_error < 0.1
    assert abs(load.D - other.D) < 4.0 * load.D_error < 1.0
    assert named.fit.rmse < 0.11
    assert identify(noisy, "fopdt").verdict.code == "too_vague"
    low, high = named.estimates["least_squares"].interval95["T"]
    assert low * 0.98 < plant.T < high * 1.02


def test_the_answer_is_carried_on_beyond_what_was_fitted():
    whole = record(*PLANTS[0])
    found = identify(whole.window(0.0, 150.0), disturbances=["load"])
    answer = without_disturbances(whole, found.model, found.disturbances)
    assert simulate_fit(found.model, answer, 150.0) == pytest.approx(answer.pv, abs=1e-3)


def test_a_column_that_says_nothing_is_left_out_with_a_note():
    quiet = record(PLANTS[0][0], Fopdt(1e-9, 10.0, 1.0), sigma=0.1)
    found = identify(quiet, disturbances=["load", "room"])
    assert found.disturbances == ()
    assert any("room never moves" in note for note in found.warnings)
    assert any("no answer to load" in note for note in found.warnings)
    assert found.model.parameters() == identify(quiet).model.parameters()


def test_a_column_that_is_not_there_is_an_error_that_names_those_that_are():
    with pytest.raises(InputError, match="load, room"):
        identify(record(*PLANTS[0]), disturbances=["heater"])


def test_a_column_between_output_and_pv_never_takes_away_what_the_record_shows():
    """A jacket's temperature answers to the output, and the PV to the jacket: named, it leaves the output nothing."""
    t = DT * np.arange(ROWS)
    output = np.where(t < 50.0, 0.0, 1.0)
    jacket = moved_by(Fopdt(1.0, 10.0, 1.0), output)
    pv = moved_by(Fopdt(2.0, 20.0, 3.0), jacket) + 0.02 * np.random.default_rng(1).standard_normal(ROWS)
    measured = Recording(t, output, pv, extra={"jacket": jacket})
    found = identify(measured, disturbances=["jacket"])
    assert found.model.parameters() == identify(measured).model.parameters()
    assert found.disturbances == ()
    assert "identified without jacket" in found.warnings[0]


def long_delayed(seed):
    rng, t = np.random.default_rng(seed), 3.0 * np.arange(200)
    load = np.where(t < 60.0, 1.0, np.where((t >= 180.0) & (t < 330.0), 1.5, 0.0))
    output = np.repeat(rng.choice([-1.0, 0.0, 2.0], 5), 40)
    answers = [(SopdtOverdamped(2.0, 100.0, 20.0, 3.0), output), (SopdtOverdamped(0.5, 100.0, 20.0, 150.0), load)]
    pv = sum(moved_by(plant, held, 3.0) for plant, held in answers) + 0.02 * rng.standard_normal((3, 200))[2]
    return Recording(t, output, pv, extra={"load": load})


def test_a_long_dead_time_of_a_disturbance_is_found_beside_a_process_that_was_a_guess():
    found = identify(long_delayed(0), disturbances=["load"])
    assert pytest.approx(150.0, abs=1.0) == found.disturbances[0].D
    assert found.fit.rmse < 0.02


def test_a_pair_of_lags_that_runs_away_from_its_guess_is_searched_again_from_one_lag():
    """From the scan alone the dead time runs to 140 s for 3 s, K to 0.3, and the disturbance is called silent."""
    found = identify(long_delayed(3), disturbances=["load"])
    assert pytest.approx(150.0, abs=5.0) == found.disturbances[0].D
    assert pytest.approx(2.0, rel=0.15) == found.model.K
    assert found.model.D < 10.0
