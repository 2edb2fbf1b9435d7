"""Records of the independent generator, each with what one rule of the search is for.

The judges are the generator's own PV, its noise and the gain of its plant, and what it hid.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from benchmarks.accuracy.diagnosis.independent import Case, record_of

pytestmark = pytest.mark.usefixtures("without_gains")


def hidden_and_found(key, seed, experiment):
    hidden = record_of(Case(key, seed, experiment))
    return hidden, diagnose(Recording.from_csv_text(hidden.csv()))


THIRD_ORDER = [
    ("load_step:step", 786, "steps"),
    ("direction_gain:kink elsewhere", 789, "steps"),
    ("sensor_hysteresis:creeping", 796, "random"),
    pytest.param("periodic_disturbance:begins", 786, "steps", marks=pytest.mark.long),
    pytest.param("gain_drift:step", 791, "relay", marks=pytest.mark.long),
]


@pytest.mark.parametrize(("key", "seed", "experiment"), THIRD_ORDER)
def test_a_plant_of_three_lags_has_them_beside_an_effect(key, seed, experiment):
    hidden, found = hidden_and_found(key, seed, experiment)
    assert hidden.plant.kind == "third"
    assert [e.name for e in found.effects] == [key.partition(":")[0]]
    assert found.to_dict()["model"]["after"]["structure"] == "third_order"
    assert found.error["fitted"].after < 1.1 * hidden.sigma
    assert found.error["held_out"].after < 1.2 * hidden.sigma


@pytest.mark.parametrize(("seed", "experiment"), [(789, "relay"), (794, "relay"), (796, "random")])
def test_a_plant_of_four_lags_has_two_after_a_pair(seed, experiment):
    """Three lags alone leave 1.25 to 1.8 sigmas on the test part."""
    hidden, found = hidden_and_found("extra_lag:four lags", seed, experiment)
    assert [(e.name, e.form) for e in found.effects] == [("extra_lag", "third and fourth")]
    assert found.error["held_out"].after < 1.1 * hidden.sigma
    low, high = found.to_dict()["model"]["after"]["interval95"]["K"]
    assert low <= hidden.gain <= high


@pytest.mark.parametrize(("key", "seed", "experiment"), [("straight", 789, "steps"), ("fouling", 786, "short")])
def test_a_gain_drifts_on_after_the_last_move(key, seed, experiment):
    hidden, found = hidden_and_found(f"gain_drift:{key}", seed, experiment)
    traces = found.traces
    last = int(np.flatnonzero(np.diff(traces.output))[-1])
    after = np.arange(traces.t.size) > max(last, int(np.searchsorted(traces.t, traces.held_out_from_s)))
    assert np.sqrt(np.mean((traces.pv - traces.after)[after] ** 2)) < 1.2 * hidden.sigma


NEAR_FORMS = [
    ("nonlinear_loss:outflow", 793, "random"),
    ("nonlinear_loss:reaction", 810, "random"),
    ("gain_drift:fouling", 810, "loop"),
]


@pytest.mark.parametrize(("key", "seed", "experiment"), NEAR_FORMS)
def test_the_interval_of_the_gain_holds_what_forms_that_come_as_near_mean(key, seed, experiment):
    """The form that is named would have the gain off by two to four half widths."""
    hidden, found = hidden_and_found(key, seed, experiment)
    assert [e.name for e in found.effects] == [key.partition(":")[0]]
    low, high = found.to_dict()["model"]["after"]["interval95"]["K"]
    assert low <= hidden.gain <= high
    assert high - low < 0.05 * abs(hidden.gain)


@pytest.mark.long  # `test_pairs` shows a load at the input of a process with a slow mode
def test_a_load_acts_on_a_process_with_a_loss_too():
    """The loss makes the process quicker, so that a load which a linear process answers is taken for a jump."""
    hidden, found = hidden_and_found("nonlinear_loss:radiation + load_step:step", 758, "random")
    assert {e.name for e in found.effects} == {"nonlinear_loss", "load_step"}
    assert found.error["held_out"].after < 1.1 * hidden.sigma


@pytest.mark.long  # `test_rounded_readings` shows it on one explanation
def test_rounding_needs_no_effect_besides():
    _, found = hidden_and_found("saturation:hard + sensor_quantisation:rounded", 756, "loop")
    assert {e.name for e in found.effects} == {"saturation", "sensor_quantisation"}


def test_moves_that_a_pipe_delays_are_no_uneven_samples():
    """Their misfit grows with the slope of the PV, as that of late samples; but it lasts."""
    hidden, found = hidden_and_found("flow_delay:pipe behind a curve", 789, "short")
    assert found.effects[0].name == "flow_delay"
    assert found.error["held_out"].after < 1.1 * hidden.sigma


def test_a_sensor_that_sends_few_readings_shows_the_gain_by_them():
    hidden, found = hidden_and_found("sensor_quantisation:on change", 791, "steps")
    low, high = found.to_dict()["model"]["after"]["interval95"]["K"]
    assert low < hidden.gain < high
    assert pytest.approx(hidden.gain, rel=0.01) == found.process.K


def test_a_gain_that_another_explanation_leaves_open_is_not_given():
    """A jump of the reading and its hysteresis explain a short record alike, and leave other gains of the process."""
    _, found = hidden_and_found("sensor_hysteresis:play", 789, "short")
    (effect,) = found.effects
    assert {effect.name, *effect.indistinguishable} == {"bias_step", "sensor_hysteresis"}
    assert found.verdict == "partly_explained"
    assert "leaves the gain of the process beside the effects open" in found.summary
