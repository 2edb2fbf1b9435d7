"""Forms that are tried in place of one that was found, on records of the independent generator.

The judges are the generator's own PV, and the form that it hid.
"""

import pytest

from autotuner import Recording, diagnose
from benchmarks.accuracy.diagnosis.independent import Case, record_of

pytestmark = pytest.mark.usefixtures("without_gains")

FORMS = [
    ("rate_limit:soft", 773, "random", "soft"),
    ("static_nonlinearity:S-shaped", 770, "relay", "S-shaped"),
    ("static_nonlinearity:power", 773, "random", "power"),
    pytest.param("saturation:rounded knee", 775, "steps", "high, soft", marks=pytest.mark.long),
    ("saturation:rounded knee", 810, "steps", "high, soft"),
    pytest.param("saturation:tanh", 795, "relay", "smooth", marks=pytest.mark.long),
    ("saturation:tanh", 796, "steps", "smooth"),
    pytest.param("nonlinear_loss:exponential", 775, "random", "exponential of the last store", marks=pytest.mark.long),
    ("nonlinear_loss:exponential", 829, "steps", "exponential of the last store"),
    ("nonlinear_loss:radiation", 775, "relay", "radiation of the last store"),
    ("nonlinear_loss:outflow", 788, "random", "outflow of the last store"),
    ("nonlinear_loss:reaction", 806, "loop", "reaction"),
    ("dead_time_jump:within a while", 775, "random", "within a while"),
    pytest.param("flow_delay:pipe behind a curve", 787, "random", "behind a curve", marks=pytest.mark.long),
    pytest.param("flow_delay:pipe behind a curve", 797, "random", "behind a curve", marks=pytest.mark.long),
    ("flow_delay:pipe behind a curve", 827, "random", "behind a curve"),
    ("drift:curved", 767, "random", "accelerating"),
    ("load_step:settling", 774, "steps", "settling"),
    ("periodic_disturbance:sawtooth", 795, "short", "sawtooth"),
    pytest.param("periodic_disturbance:sawtooth", 811, "relay", "sawtooth", marks=pytest.mark.long),
    pytest.param("time_proportioning:latched", 784, "random", "", marks=pytest.mark.long),
    pytest.param("time_proportioning:latched", 807, "relay", "", marks=pytest.mark.long),
    pytest.param("time_proportioning:latched", 797, "relay", "", marks=pytest.mark.long),
    ("time_proportioning:latched", 827, "relay", ""),
    pytest.param(
        "time_proportioning:carrier", 784, "loop", "by a carrier from the start", marks=pytest.mark.long
    ),  # the form is exchanged for `latched`, too
]
"""What was hidden, seed, experiment, and the form that is named."""


@pytest.mark.parametrize(("key", "seed", "experiment", "form"), FORMS)
def test_the_form_that_was_hidden_takes_the_place_of_a_near_one(key, seed, experiment, form):
    hidden = record_of(Case(key, seed, experiment))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert [(e.name, e.form) for e in answer.effects] == [(key.partition(":")[0], form)]
    assert answer.error["held_out"].after < 1.1 * hidden.sigma


def test_a_band_that_the_fitted_part_leaves_open_is_chosen_by_the_selection_part():
    """Under a relay every move is wider than the band; only the steps that follow are not."""
    hidden = record_of(Case("stiction:stick and slip", 783, "relay"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    (effect,) = answer.effects
    low, high = effect.interval95["jump"]
    assert effect.name == "stiction"
    assert low < hidden.hidden.sizes["jump"] < high
    assert answer.error["held_out"].after < 1.1 * hidden.sigma
    assert answer.verdict == "partly_explained"
    assert "not proven: stiction is a hypothesis: the record leaves its band open" in answer.summary


LEFT_OPEN = [("actuator_hold:even", 789, "steps"), ("stiction:stick and slip", 798, "relay")]


@pytest.mark.parametrize(("key", "seed", "experiment"), LEFT_OPEN)
def test_what_the_moves_leave_open_is_chosen_so_that_later_ones_are_foreseen(key, seed, experiment):
    """Phases of updates beside other dead times, and bands between two moves, explain the record alike."""
    hidden = record_of(Case(key, seed, experiment))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert [e.name for e in answer.effects] == [key.partition(":")[0]]
    assert answer.error["held_out"].after < 1.1 * hidden.sigma


def test_a_band_as_wide_as_a_move_is_found():
    """Such a move slips on in the direction of the one before, and sticks in the other one."""
    hidden = record_of(Case("stiction:stick and slip", 793, "relay"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert [e.name for e in answer.effects] == ["stiction"]
    assert answer.error["held_out"].after < 1.1 * hidden.sigma


def test_a_curve_of_many_knots_gives_way_to_steps_that_foresee_other_levels():
    hidden = record_of(Case("output_quantisation:even", 795, "relay"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert [e.name for e in answer.effects] == ["output_quantisation"]
    assert answer.error["held_out"].after < 1.1 * hidden.sigma


def test_pulses_that_a_loop_answers_are_no_uneven_sampling():
    """One residual is nine times the deviation that sampling times and noise would give it."""
    hidden = record_of(Case("time_proportioning:carrier", 794, "loop"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert "timing_jitter" not in {e.name for e in answer.effects}
