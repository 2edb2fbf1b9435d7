"""What acts between controller and process: against the simulator, which shares no code with it."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from autotuner.core.design import design
from autotuner.core.design.simulation.actuators import Setting, actuator_of, predictable, seats
from autotuner.core.design.simulation.closed_loop import Scenario, predict
from autotuner.core.design.simulation.pid import PidSettings
from autotuner.core.design.simulation.verification import Decision, Verification, predicted_band
from autotuner.core.model.process import Fopdt
from autotuner_sim.effects import Backlash, RateLimit
from autotuner_sim.effects.friction import HeStiction

COMMANDS = np.cumsum(np.random.default_rng(3).normal(size=400)).tolist()
MODEL = Fopdt(2.0, 10.0, 1.5)


def effect(name, **sizes):
    return SimpleNamespace(name=name, parameters=sizes)


def acting(*effects, rest=0.0, sample_time_s=0.5):
    return actuator_of(effects, Setting(rest, sample_time_s))


@pytest.mark.parametrize(
    ("ours", "judge"),
    [
        (effect("backlash", width=1.4), Backlash(1.4)),
        (effect("stiction", band=1.5, jump=0.9), HeStiction(1.5, 0.6)),
        (effect("rate_limit", rate_per_s=1.2), RateLimit(1.2)),
    ],
    ids=["backlash", "stiction", "rate limit"],
)
def test_it_moves_as_in_the_simulator(ours, judge):
    act = acting(ours)
    judge.rest(0.0)
    assert [act(u) for u in COMMANDS] == pytest.approx([judge.act(u, 0.5) for u in COMMANDS], abs=1e-12)


def test_a_positioner_approaches_like_a_lag_by_a_limited_rate():
    """Rate 1.2 a second, lag 0.8 s: within 0.96 of the end of a step of 3 the rest fades."""
    act = acting(effect("rate_limit", rate_per_s=1.2, lag_s=0.8), sample_time_s=0.001)
    course = [act(3.0) for _ in range(4000)]
    assert course[999] == pytest.approx(1.2, abs=0.01)
    limited_s = (3.0 - 1.2 * 0.8) / 1.2
    assert course[3199] == pytest.approx(3.0 - 1.2 * 0.8 * math.exp(-(3.2 - limited_s) / 0.8), abs=0.01)


def test_limits_are_those_of_the_output_and_positions_deviations():
    act = acting(effect("saturation", low=35.0, high=45.0), rest=44.0)
    assert [act(u) for u in (3.0, -4.0, -20.0)] == [1.0, -4.0, -9.0]


def test_steps_holds_and_curves():
    assert [acting(effect("output_quantisation", step=0.5))(u) for u in (0.2, 0.3, 1.1)] == [0.0, 0.5, 1.0]
    held = acting(effect("actuator_hold", period_s=1.0))
    assert [held(u) for u in (1.0, 2.0, 3.0, 4.0)] == [1.0, 1.0, 3.0, 3.0]
    assert acting(effect("static_nonlinearity", curvature=0.1))(2.0) == pytest.approx(2.4)
    assert [acting(effect("direction_gain", ratio=0.5))(u) for u in (2.0, -2.0)] == [1.0, -2.0]


def test_effects_act_in_the_order_of_the_actuator_and_others_are_left_out():
    found = [effect("load_step", size=1.0), effect("backlash", width=1.0), effect("saturation", high=2.0)]
    assert [e.name for e in predictable(found)] == ["saturation", "backlash"]
    assert acting(found[0]) is None
    assert acting(*found)(9.0) == 1.5  # cut at 2, then half the play behind it


def verified(known, hidden, model=MODEL, truth=MODEL):
    """Return what the judge says of a loop with the hidden effects when it knows of the known ones."""
    settings = PidSettings(design(model).gains)
    scenario = Scenario(90.0, 0.2, set_point_step=1.0, load_step=0.5)
    band = predicted_band(model, settings, scenario, noise_sigma=0.01, effects=known)
    noise = 0.01 * np.random.default_rng(4).standard_normal(460)
    for make in seats(hidden, 0.0, 0.2):
        seen, judge = predict(truth, settings, scenario, actuator=make(), noise=noise), Verification(band)
        yield next(
            decision
            for k in range(seen.t.size)
            if (decision := judge.step(float(seen.t[k]), float(seen.pv[k]), float(seen.output[k])))
            is not Decision.GO_ON
        )


def test_a_play_that_the_diagnosis_found_is_in_the_prediction():
    play = [effect("backlash", width=0.3)]
    assert Decision.ROLL_BACK in set(verified([], play))
    assert set(verified(play, play)) == {Decision.PASS}


@pytest.mark.parametrize("truth", [Fopdt(4.0, 10.0, 1.5), Fopdt(1.0, 10.0, 1.5), Fopdt(2.0, 10.0, 3.0)], ids=str)
def test_a_wrong_model_goes_back_beside_a_known_play_too(truth):
    play = [effect("backlash", width=0.3)]
    assert set(verified(play, play, truth=truth)) == {Decision.ROLL_BACK}
