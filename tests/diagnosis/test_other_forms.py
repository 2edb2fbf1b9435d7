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
    ("saturation:rounded knee", 775, "steps", "high, soft"),
    ("nonlinear_loss:exponential", 775, "random", "exponential of the last store"),
    ("nonlinear_loss:radiation", 775, "relay", "radiation of the last store"),
    ("nonlinear_loss:outflow", 788, "random", "outflow of the last store"),
    ("dead_time_jump:within a while", 775, "random", "within a while"),
    ("drift:curved", 767, "random", "accelerating"),
    ("load_step:settling", 774, "steps", "settling"),
    ("time_proportioning:latched", 784, "random", ""),
    ("time_proportioning:carrier", 784, "loop", "by a carrier from the start"),
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
