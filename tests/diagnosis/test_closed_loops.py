"""Effects on the record of a PI loop, whose output moves at every sample. Truths are the independent generator's."""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.record.sensor import spikes_of
from benchmarks.accuracy.diagnosis.independent import Case, record_of

pytestmark = pytest.mark.usefixtures("without_gains")


def answer_to(key, seed):
    record = record_of(Case(key, seed, "loop"))
    return diagnose(Recording.from_csv_text(record.csv())), record.hidden.sizes


def again(*values):
    """The same on another record: for `run.py long`."""
    return pytest.param(*values, marks=pytest.mark.long)


def named(answer):
    return [effect.name for effect in answer.effects]


@pytest.mark.parametrize("seed", [again(521), again(601)])
def test_updates_at_even_times_are_found_by_the_answer_to_all_of_them(seed):
    answer, sizes = answer_to("actuator_hold:even", seed)
    assert named(answer) == ["actuator_hold"]
    assert answer.effects[0].parameters["period_s"] == pytest.approx(sizes["period_s"], rel=2e-3)


@pytest.mark.parametrize("seed", [again(603), again(593), again(768)])
def test_steps_of_an_actuator_are_found_though_the_output_has_no_levels(seed):
    answer, sizes = answer_to("output_quantisation:even", seed)
    assert named(answer) == ["output_quantisation"]
    assert answer.effects[0].parameters["step"] == pytest.approx(sizes["step"], rel=2e-3)


@pytest.mark.long
def test_steps_are_found_beside_a_drift():
    hidden = record_of(Case("output_quantisation:even + drift:straight", 744, "loop"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert {e.name for e in answer.effects} == {"output_quantisation", "drift"}
    assert answer.error["held_out"].after < 1.1 * hidden.sigma


@pytest.mark.parametrize("seed", [again(601), again(521)])
def test_a_valve_sticks_within_much_less_than_the_set_point_moves_it(seed):
    answer, sizes = answer_to("stiction:stick and slip", seed)
    assert named(answer) == ["stiction"]
    assert answer.effects[0].parameters["jump"] == pytest.approx(sizes["jump"], rel=0.1)


@pytest.mark.parametrize(
    ("key", "seed"),
    [("saturation:hard", 745), again("saturation:hard", 754), again("static_nonlinearity:S-shaped", 758)],
)
def test_an_actuator_that_ends_before_the_output_is_found_though_the_controller_moves_on(key, seed):
    answer, sizes = answer_to(key, seed)
    assert named(answer) == [key.partition(":")[0]]
    if sizes:
        assert answer.effects[0].parameters["high"] == pytest.approx(sizes["high"], rel=2e-3)


@pytest.mark.parametrize("seed", [again(768)])
def test_a_wave_that_begins_while_the_controller_answers_is_found(seed):
    answer, sizes = answer_to("periodic_disturbance:begins", seed)
    assert named(answer) == ["periodic_disturbance"]
    assert answer.effects[0].parameters["period_s"] == pytest.approx(sizes["period_s"], rel=1e-2)


@pytest.mark.long
def test_what_was_found_beside_a_disturbance_is_reported_beside_what_does_as_well_without_it():
    answer, _ = answer_to("recycle:pipe", 770)
    (effect,) = answer.effects
    assert {effect.name, *effect.indistinguishable} == {"slow_mode", "recycle"}


@pytest.mark.parametrize("seed", [again(759)])
def test_a_weak_loss_is_found_though_each_start_of_the_search_is_far_stronger(seed):
    answer, _ = answer_to("nonlinear_loss:outflow", seed)
    assert named(answer) == ["nonlinear_loss"]


@pytest.mark.long  # without a controller it is in test_records_without_segments, and wild readings are below
def test_a_reading_that_stays_off_while_the_controller_answers_has_no_wild_readings():
    answer, sizes = answer_to("bias_step:jump", 521)
    assert named(answer) == ["bias_step"]
    assert answer.effects[0].parameters["size"] == pytest.approx(sizes["size"], rel=0.01)


@pytest.mark.parametrize(("seed", "plant"), [(602, "integrating"), pytest.param(603, None, marks=pytest.mark.long)])
def test_autoregressive_noise_in_a_short_record_is_no_effect(seed, plant):
    record = record_of(Case("clean", seed, "short", "coloured", plant))
    assert diagnose(Recording.from_csv_text(record.csv())).verdict == "adequate"


@pytest.mark.parametrize(("seed", "experiment"), [again(754, "random"), (758, "short"), again(750, "steps")])
def test_autoregressive_noise_on_a_plant_of_third_order_is_no_effect(seed, experiment):
    """It hides that lag, which the innovations show, and it looks like a load for a while."""
    record = record_of(Case("clean", seed, experiment, "coloured"))
    answer = diagnose(Recording.from_csv_text(record.csv()))
    assert (answer.verdict, answer.effects) == ("adequate", ())


@pytest.mark.parametrize(("seed", "noise"), [(750, "white"), pytest.param(747, "coloured", marks=pytest.mark.long)])
def test_a_relay_record_that_ends_in_steps_is_adequate_though_its_numbers_were_unsure_until_then(seed, noise):
    """What a relay leaves open of the process makes an error at the steps, and no effect is missing."""
    record = record_of(Case("clean", seed, "relay", noise))
    answer = diagnose(Recording.from_csv_text(record.csv()))
    assert (answer.verdict, answer.effects) == ("adequate", ())


@pytest.mark.parametrize("run", [[5.0], [5.0, 5.0, 5.0], [3.0, 5.0], [-4.0, 6.0]])
def test_a_short_run_that_comes_back_by_a_jump_is_wild(run):
    residual = 0.1 * np.random.default_rng(1).standard_normal(200)
    residual[100 : 100 + len(run)] += run
    assert np.flatnonzero(spikes_of(residual, 0.1)).tolist() == list(range(100, 100 + len(run)))


def test_what_fades_after_a_jump_is_not_wild():
    residual = 0.02 * np.random.default_rng(1).standard_normal(200)
    residual[100:] += 6.0 * np.exp(-np.maximum(np.arange(100) - 2.0, 0.0) / 5.0)
    assert not spikes_of(residual, 0.02).any()
