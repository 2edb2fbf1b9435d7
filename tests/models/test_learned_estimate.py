"""The learned estimate: right, without a scale of its own, with errors that hold, silent where it was not trained."""

import math

import numpy as np
import pytest

from autotuner.core.identification import identify
from autotuner.core.identification.learned.correction import by_learned
from autotuner.core.recording import Recording
from autotuner_models.learned.artefacts import SHIPPED, load
from autotuner_models.learned.draw import STRUCTURES, rows_of
from autotuner_sim import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped

PLANTS = {
    "fopdt": Fopdt(1.65, 20.0, 10.0),
    "sopdt_overdamped": SopdtOverdamped(1.0, 10.0, 4.0, 2.0),
    "sopdt_underdamped": SopdtUnderdamped(3.5, 9.4, 3.7, 7.0),
    "integrating": Integrating(0.1, 5.0, 2.0),
}
MS, HOURS = 1e-3, 3600.0


@pytest.fixture(scope="module")
def models():
    return load(SHIPPED)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_it_finds_the_process(models, record, structure):
    plant = PLANTS[structure]
    estimate = by_learned(record(plant), structure, (plant.K, 0.0), models)
    assert estimate.refusal is None
    for name, value in estimate.model.parameters().items():
        assert value == pytest.approx(getattr(plant, name), rel=0.02)


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize(("time", "pv", "output"), [(MS, 1.0, 1.0), (HOURS, 250.0, 0.01), (1.0, 1e-4, 1e3)])
def test_the_same_plant_at_another_scale_has_the_same_answer(models, record, structure, time, pv, output):
    plant = PLANTS[structure]
    one = record(plant, decibels=30.0)
    sigma = one.settings["noise_sigma"]
    other = Recording(one.t * time, one.output * output, one.pv * pv, settings={"noise_sigma": sigma * pv})
    K = 1.01 * plant.K
    per_time = time if structure == "integrating" else 1.0
    here = by_learned(one, structure, (K, 0.0), models)
    there = by_learned(other, structure, (K * pv / output / per_time, 0.0), models)
    scales = {"K": pv / output / per_time, "m": time**2}
    for name, value in here.model.parameters().items():
        scale = scales.get(name, time)
        assert there.model.parameters()[name] == pytest.approx(value * scale, rel=1e-9)
        assert there.standard_error[name] == pytest.approx(here.standard_error[name] * scale, rel=1e-9)


def test_a_process_of_negative_gain_is_its_mirror_image(models, record):
    """Also through the whole identification, whose gain is a number and not a sign."""
    for K in (2.0, -2.0):
        plant = Fopdt(K, 10.0, 3.0)
        found = identify(record(plant), learned=models).estimates["learned"]
        assert found.model.parameters() == pytest.approx({"K": K, "T": 10.0, "D": 3.0}, rel=0.01)
        low, high = found.interval95["K"]
        assert low <= found.model.K <= high


@pytest.mark.one_of(3)
@pytest.mark.parametrize("structure", STRUCTURES)
def test_predicted_errors_hold_on_new_experiments(models, structure):
    """Of a seed that was not trained on, under all conditions of the training."""
    parts = [rows_of(structure, 256, (900_001, STRUCTURES.index(structure), i)) for i in range(12)]
    X, truth, start = (np.concatenate([getattr(part, key) for part in parts]) for key in ("X", "truth", "start"))
    correction = models.corrections[structure]
    inside = np.array([correction.domain.beyond(row) <= 1.0 for row in X])
    assert inside.mean() > 0.99
    values, errors = correction.apply(X[inside], start[inside])
    over = np.abs(truth[inside] - values) / errors
    assert ((over <= 1.0).mean(axis=0) > 0.60).all()
    assert ((over <= 1.0).mean(axis=0) < 0.76).all()
    assert ((over <= correction.q95).mean(axis=0) > 0.92).all()
    assert ((over <= correction.q95).mean(axis=0) < 0.98).all()
    before, after = (np.median(np.abs(truth[inside] - found), axis=0) for found in (start[inside], values))
    assert (after[:-1] <= before[:-1]).all()


OUTSIDE = {
    "hardly sampled": ({"per_period": 4}, "outside of the training domain"),
    "dead time without lag": ({"plant": Fopdt(1.0, 1.0, 60.0)}, "outside of those that it was trained on"),
    "nothing but a lag": ({"plant": Fopdt(1.0, 500.0, 1.0)}, "outside of"),
}


@pytest.mark.parametrize("case", OUTSIDE)
def test_outside_of_the_training_it_refuses(models, record, case):
    changed, said = OUTSIDE[case]
    given = {"plant": PLANTS["fopdt"]} | changed
    estimate = by_learned(record(**given), "fopdt", (given["plant"].K, 0.0), models)
    assert estimate.model is None
    assert said in estimate.refusal


def test_a_record_buried_in_noise_is_refused(models, record):
    clean = record(PLANTS["fopdt"], per_period=40)
    sigma = 3.0 * float(np.ptp(clean.pv))
    noise = sigma * np.random.default_rng(1).standard_normal(clean.pv.size)
    buried = Recording(clean.t, clean.output, clean.pv + noise, settings={"noise_sigma": sigma})
    assert by_learned(buried, "fopdt", (1.65, 0.0), models).model is None


def test_a_gain_that_the_oscillation_contradicts_is_refused(models, record):
    plant = PLANTS["fopdt"]
    estimate = by_learned(record(plant), "fopdt", (0.05 * plant.K, 0.0), models)
    assert estimate.model is None
    assert "static gain" in estimate.refusal


def test_a_step_test_holds_no_oscillation(models):
    t = np.arange(200.0)
    step = Recording(t, (t > 20.0) * 1.0, 1.0 - np.exp(-np.maximum(t - 25.0, 0.0) / 30.0))
    assert "no oscillation" in by_learned(step, "fopdt", (1.0, 0.0), models).refusal


def test_without_trained_files_the_reason_is_passed_on(record):
    plant = PLANTS["fopdt"]
    assert by_learned(record(plant), "fopdt", (plant.K, 0.0), "files were moved").refusal == "files were moved"


def test_a_row_alone_is_what_it_is_in_a_batch(models):
    rows = rows_of("fopdt", 32, (5, 0, 0))
    together = models.corrections["fopdt"].apply(rows.X, rows.start)
    alone = [models.corrections["fopdt"].apply(rows.X[i : i + 1], rows.start[i : i + 1]) for i in range(8)]
    for i, (values, errors) in enumerate(alone):
        assert values[0] == pytest.approx(together[0][i], rel=1e-12)
        assert errors[0] == pytest.approx(together[1][i], rel=1e-12)


def test_structures_are_told_apart_by_the_shape_of_the_wave(models, record):
    likely = by_learned(record(PLANTS["fopdt"]), None, (1.65, 0.0), models)
    assert max(likely.evidence["structure_probability"], key=likely.evidence["structure_probability"].get) == "fopdt"
    assert math.isclose(sum(likely.evidence["structure_probability"].values()), 1.0)
