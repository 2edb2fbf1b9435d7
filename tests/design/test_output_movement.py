"""How much of the output noise and resolution of the PV move, and the limit of it that every goal has."""

import math

import numpy as np
import pytest

from autotuner.core.design import Basis, DesignSpec, DeviceController, design_from_spec, noise_of
from autotuner.core.design.requirements import GOALS, MOVEMENT
from autotuner.core.model.process import Fopdt
from autotuner.core.notes import Note
from autotuner.core.signals.noise import quantisation

H, SPAN = 0.1, 100.0
HEATER = Fopdt(2.0, 10.0, 1.5)
DEVICE = DeviceController(N=8.0)


def moved(model, gains, h, disturb, seconds=2000.0):
    """Return the standard deviation of the output of a sampled PID controller in plain difference equations."""
    decay, delay = math.exp(-h / model.T), round(model.D / h)
    x, integral, yd, before, outputs = 0.0, 0.0, 0.0, 0.0, [0.0] * (delay + 1)
    share = 1.0 - math.exp(-h * gains.N / gains.Td) if gains.Td and math.isfinite(gains.N) else 1.0
    for k in range(round(seconds / h)):
        y = disturb(x, k)
        slow = yd + share * (y - yd)
        rate, yd, before = (slow - yd) / h, slow, y
        integral -= h * gains.Kp / gains.Ti * before
        outputs.append(-gains.Kp * y + integral - gains.Kp * gains.Td * rate)
        x = decay * x + (1.0 - decay) * model.K * outputs[-1 - delay]
    return float(np.std(outputs[len(outputs) // 5 :]))


@pytest.mark.one_of(3)
@pytest.mark.parametrize("goal", list(GOALS))
def test_a_goal_keeps_its_limit_and_the_output_moves_as_predicted(goal):
    noise, random = noise_of(0.05, 0.05, H), np.random.default_rng(1)
    free = design_from_spec(Basis(HEATER, None, H, noise, None, DEVICE), DesignSpec(goal))
    found = design_from_spec(Basis(HEATER, None, H, noise, None, DEVICE, SPAN), DesignSpec(goal))
    assert found.jitter_limit == pytest.approx(MOVEMENT[goal] * SPAN)
    assert (free.jitter_limit, free.goal, found.goal) == (None, goal, goal)
    white = 0.05 * random.standard_normal(20_001)
    assert moved(HEATER, found.gains, H, lambda x, k: x + white[k]) == pytest.approx(found.jitter, rel=0.12)
    assert found.jitter <= 1.01 * found.jitter_limit
    if free.jitter > found.jitter_limit:
        (note,) = [text for text in found.warnings if "noise and resolution" in text]
        assert isinstance(note, Note)
        assert f"by {free.jitter:.2g} " in note


def test_without_noise_the_gains_are_as_they_were():
    for basis in (Basis(HEATER, None, H), Basis(HEATER, None, H, noise_of(1e-6, 1e-6, H), None, DEVICE)):
        limited = Basis(basis.model, None, H, basis.noise, None, basis.device, SPAN)
        before, after = (design_from_spec(one, DesignSpec("balanced"), compared=False) for one in (basis, limited))
        assert after.gains == before.gains
        assert after.warnings == before.warnings


def test_a_coarse_sensor_is_noise_even_where_it_stands_still():
    """A board with a sensor step of 0.16 degC and a slow plant: the gain would be large, and each step a kick."""
    board = Fopdt(0.6, 150.0, 5.0)
    free = design_from_spec(Basis(board, None, 1.0, None, None, DEVICE, SPAN), DesignSpec("brisk"))
    noise = noise_of(0.0, 0.02, 1.0, resolution=0.16)
    assert noise.sigma == pytest.approx(0.16 / math.sqrt(12.0))
    found = design_from_spec(Basis(board, None, 1.0, noise, None, DEVICE, SPAN), DesignSpec("brisk"))
    assert found.jitter <= 1.01
    assert found.gains.Kp < 0.7 * free.gains.Kp


def test_a_rule_that_makes_the_actuator_work_for_nothing_is_warned_of():
    found = design_from_spec(
        Basis(HEATER, None, H, noise_of(0.3, 0.3, H), None, DEVICE, SPAN), DesignSpec(rule="amigo_pid")
    )
    assert [text for text in found.warnings if "would work for nothing" in text and not isinstance(text, Note)]
    loud = [one for one in found.alternatives if one.jitter and one.jitter > found.jitter_limit]
    assert loud
    assert all(any("would work for nothing" in text for text in one.warnings) for one in loud)


def test_the_grid_of_a_sensor():
    grid = np.round(np.random.default_rng(2).normal(80.0, 1.0, 500) / 0.16) * 0.16
    assert quantisation(grid) == pytest.approx(0.16)
    assert quantisation(np.random.default_rng(2).normal(80.0, 1.0, 500)) == 0.0
    assert quantisation(np.full(10, 3.0)) == 0.0
