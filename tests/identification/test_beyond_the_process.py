"""What moves the PV besides the output: a straight line under a record that never rests, surroundings that warm up."""

import numpy as np
import pytest

from autotuner.core.identification import identify, simulate_fit
from autotuner.core.recording import Recording
from autotuner_sim.plants import Fopdt


@pytest.fixture
def moved(record):
    """A first-order process that a random output has moved since long before the record begins."""
    output = np.repeat(np.random.default_rng(3).choice((-1.0, 1.0), size=80), 5)
    whole = record(Fopdt(2.0, 4.0, 1.0), 0.5, lambda k, _: output[k], output.size, sigma=0.02, rest=-1.0)
    return whole.window(50.0, 200.0)


def test_a_line_under_a_random_output_is_not_taken_for_the_process(moved):
    drifting = Recording(moved.t, moved.output, moved.pv + 0.01 * moved.t)
    found = identify(drifting)
    assert "drift" in found.estimates["least_squares"].evidence["background"]
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 4.0, "D": 1.0}, rel=0.02)
    carried_on = simulate_fit(found.model, drifting, fitted_until_s=125.0)
    assert np.std((drifting.pv - carried_on)[drifting.t > 125.0]) < 0.03


def test_no_line_is_seen_where_there_is_none(moved):
    assert "drift" not in identify(moved).estimates["least_squares"].evidence["background"]


def test_an_output_before_the_record_that_no_record_shows_is_told(moved):
    warming = Recording(moved.t, moved.output, moved.pv - 40.0 * np.exp(-(moved.t - moved.t[0]) / 12.0))
    assert any("before the record" in warning for warning in identify(warming).warnings)
    assert not any("before the record" in warning for warning in identify(moved).warnings)
