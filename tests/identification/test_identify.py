"""The identification as a whole: side by side, JSON, invariance, refusals that carry numbers."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from autotuner.core.estimation.decimate import condensed
from autotuner.core.estimation.simulation import response
from autotuner.core.identification import identify, simulate_fit
from autotuner.core.identification.limit_cycle.from_cycle import Known, by_describing_function
from autotuner.core.model.process import STRUCTURES, Fopdt, Integrating, UnstableFopdt
from autotuner.core.recording import Recording
from autotuner.core.verdict import Outcome
from autotuner.errors import InputError
from autotuner_sim import plants


@pytest.fixture(scope="module")
def relay_test(record_relay):
    return record_relay(plants.Fopdt(2.0, 10.0, 1.5), 0.1, switches=9, sigma=0.02, hysteresis=0.06, quiet=50, seed=4)


@pytest.fixture(scope="module")
def found(relay_test):
    return identify(relay_test)


def test_every_estimator_stands_beside_the_others(found):
    assert set(found.estimates) == {"describing_function", "closed_form", "least_squares", "learned"}
    assert found.recommended == "least_squares"
    assert found.verdict.outcome is Outcome.DONE
    truth = {"K": 2.0, "T": 10.0, "D": 1.5}
    best = found.estimates["least_squares"]
    for name, value in best.model.parameters().items():
        assert abs(value - truth[name]) < 3.0 * best.standard_error[name] < 0.1 * truth[name]
    assert found.estimates["closed_form"].model.parameters() == pytest.approx(truth, rel=0.05)
    # On the fundamental the describing function has no bias in T; on the peak T comes out about 18 % too small.
    assert pytest.approx(10.0, rel=0.05) == found.estimates["describing_function"].model.T
    peak = by_describing_function(found.limit_cycle, Known(2.0, "given"), None, "fopdt", "peak")
    assert pytest.approx(8.1, rel=0.08) == peak.model.T
    fits = {name: estimate.fit_percent for name, estimate in found.estimates.items() if estimate.model}
    assert fits["describing_function"] < fits["closed_form"] <= fits["least_squares"] + 1e-9


def test_json_holds_numbers_and_nulls_only(found):
    values = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert values["structure"] == "fopdt"
    assert set(values["model"]) == {"K", "T", "D"}
    assert {"Pu", "A", "A1", "Ku"} <= set(values["limit_cycle"])
    assert set(values["estimates"]["least_squares"]["standard_error"]) == {"K", "T", "D"}
    assert set(values["fit"]) == {"rmse", "fit_percent", "noise_sigma", "unexplained", "resolution"}
    assert values["verdict"]["outcome"] == "done"
    refused = json.loads(json.dumps(identify(flat(0.0, 1.0)).to_dict(), allow_nan=False))
    assert refused["model"] is None
    assert refused["fit"]["rmse"] is None


def test_noise_is_measured(found):
    assert found.fit.noise_sigma == pytest.approx(0.02, rel=0.2)
    assert found.fit.rmse == pytest.approx(0.02, rel=0.15)


def test_second_order_describing_function_uses_the_fundamental(record_relay):
    plant = plants.SopdtOverdamped(1.0, 10.0, 2.0, 4.0)
    found = identify(record_relay(plant, 0.05, switches=9))
    estimate = found.estimates["describing_function"]
    assert estimate.evidence["amplitude"] == "fundamental"
    assert pytest.approx(10.0, rel=0.1) == estimate.model.T1


scales = st.floats(-4.0, 4.0).map(lambda decade: 10.0**decade)


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(time=scales, pv=scales, output=scales, offset=st.floats(-100.0, 100.0))
def test_units_do_not_matter(relay_test, found, time, pv, output, offset):
    base = found
    other = identify(
        Recording(relay_test.t * time, relay_test.output * output + offset, relay_test.pv * pv + offset * pv)
    )
    expected = {"K": base.model.K * pv / output, "T": base.model.T * time, "D": base.model.D * time}
    assert other.structure == base.structure
    assert other.model.parameters() == pytest.approx(expected, rel=1e-4)
    low, high = base.estimates["least_squares"].interval95["T"]
    assert other.estimates["least_squares"].interval95["T"] == pytest.approx((low * time, high * time), rel=1e-3)


MODELS = {
    "fopdt": Fopdt(2.0, 10.0, 1.5),
    "sopdt_overdamped": STRUCTURES["sopdt_overdamped"](1.0, 8.0, 3.0, 1.0),
    "no second lag": STRUCTURES["sopdt_overdamped"](1.0, 8.0, 0.0, 1.0),
    "integrating": Integrating(0.1, 3.0, 1.0),
    "pure integrator": Integrating(0.1, 0.0, 1.0),
    "unstable": UnstableFopdt(1.0, 40.0, 1.0),
    "inverse_response": STRUCTURES["inverse_response"](1.0, 8.0, 3.0, 2.0, 1.0),
    "one lag with zero": STRUCTURES["inverse_response"](1.0, 8.0, 0.0, 2.0, 1.0),
}


@pytest.mark.parametrize("name", list(MODELS))
def test_simulation_repeats_what_the_model_made(name):
    t = np.arange(0.0, 60.0, 0.2)
    output = np.where(t > 5.0, np.where(t % 20.0 > 12.0, 1.0, -0.5), 0.0)
    pv = 40.0 + response(MODELS[name], t, output)
    assert simulate_fit(MODELS[name], Recording(t, output, pv)) == pytest.approx(pv, abs=1e-8 * np.ptp(pv))


def flat(output, pv, n=100):
    return Recording(np.arange(n, dtype=float), np.full(n, output), np.full(n, pv))


def noise(n=300, seed=1):
    return np.random.default_rng(seed).standard_normal(n)


STEP = (np.arange(300) >= 100).astype(float)

REFUSED = {
    "too_few_samples": Recording(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([0.0, 0.5])),
    "constant_output": Recording(np.arange(300.0), np.full(300, 4.0), noise()),
    "constant_pv": Recording(np.arange(300.0), STEP, np.full(300, 7.0)),
    "no_answer": Recording(np.arange(300.0), STEP, noise()),
}


@pytest.mark.parametrize("code", list(REFUSED))
def test_records_that_show_no_process_are_refused_with_a_remedy(code):
    found = identify(REFUSED[code])
    assert found.model is None
    assert found.recommended is None
    assert found.verdict.outcome is Outcome.REFUSED
    assert found.verdict.code == code
    assert found.verdict.remedy
    assert any(character.isdigit() for character in found.verdict.message)
    assert all(estimate.model is None for estimate in found.estimates.values())


@pytest.mark.one_of(3)
@pytest.mark.parametrize("seed", range(6))
def test_noise_alone_is_never_taken_for_an_answer(seed):
    relay = np.where(np.arange(400) // 50 % 2, 1.0, -1.0)
    assert identify(Recording(np.arange(400.0), relay, noise(400, seed))).verdict.outcome is Outcome.REFUSED


def test_a_single_late_step_leaves_a_warning(record):
    found = identify(record(plants.Fopdt(2.0, 100.0, 1.0), 0.5, lambda k, _: float(k > 50), 90, sigma=0.001, seed=3))
    assert found.model is None or any("cannot be separated" in w or "uncertain" in w for w in found.warnings)


def test_a_saturated_sensor_is_named(record_relay):
    record = record_relay(plants.Fopdt(2.0, 10.0, 3.0), 0.1, switches=9, sigma=0.01, hysteresis=0.03)
    clipped = Recording(record.t, record.output, np.minimum(record.pv, 0.5))
    assert any("saturated" in warning for warning in identify(clipped).warnings)


@pytest.mark.long  # tests/core/test_first_try has an unstable process
def test_a_growing_oscillation_does_not_break_it():
    t = np.arange(0.0, 50.0, 0.25)
    found = identify(Recording(t, np.sign(np.sin(t)), np.exp(0.3 * t) * np.sin(t)))
    assert found.verdict.message


def test_a_very_long_record_is_condensed_and_says_so():
    t = np.arange(40_000) * 0.05
    output = np.where(t % 200.0 > 100.0, 1.0, -1.0)
    pv = response(Fopdt(2.0, 30.0, 4.567), t, output)
    found = identify(Recording(t, output, pv))
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 30.0, "D": 4.567}, rel=1e-6)
    assert any("of 40000 samples were used" in warning for warning in found.warnings)


def test_an_output_that_always_moves_is_condensed_to_its_means():
    rng = np.random.default_rng(1)
    t = np.arange(60_000) * 0.01
    output = np.repeat(rng.standard_normal(600), 100) + 0.1 * rng.standard_normal(60_000)
    short = condensed(Recording(t, output, response(Fopdt(2.0, 30.0, 4.0), t, output)))
    assert len(short) <= 20_000
    assert short.output[0] == pytest.approx(output[:3].mean(), rel=1e-12)
    assert condensed(short) is short


def test_unknown_structure_and_impossible_gain_are_refused_by_name(relay_test):
    with pytest.raises(InputError) as error:
        identify(relay_test, structure="fifth_order")
    assert error.value.field == "structure"
    for gain in (0.0, float("nan"), float("inf")):
        with pytest.raises(InputError) as error:
            identify(relay_test, known_gain=gain)
        assert error.value.field == "known_gain"


def test_a_structure_that_the_record_contradicts_is_refused(record_relay):
    found = identify(record_relay(plants.SopdtOverdamped(1.0, 10.0, 3.0, 2.0), 0.1), "sopdt_underdamped")
    assert found.verdict.code == "structure_does_not_fit"


def test_a_process_beyond_the_structures_is_reported_with_its_misfit(record_relay):
    found = identify(record_relay(plants.LagChain(1.0, (2.0,) * 12, 0.0), 0.4, switches=9))
    assert found.fit.fit_percent > 90.0
    assert any("not noise alone" in warning for warning in found.warnings)
