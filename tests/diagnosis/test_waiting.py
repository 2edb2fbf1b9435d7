"""The PV of a loop waits where its valve sticks, and follows where it moves freely; neither is seen elsewhere."""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.waiting import Waiting, waiting, waiting_of

pytestmark = pytest.mark.usefixtures("without_gains")

NOTHING = Waiting(sticks=False, follows=False)


def flow_loop(band, n=1200, seed=1, wander=0.0):
    """A flow of one lag of 3 s under PI, 1 s, whose valve jumps where the command is `band` away from it."""
    random = np.random.default_rng(seed)
    u, y = np.zeros(n), np.zeros(n)
    command, flow, position, integral, load = 0.0, 1.5, 0.0, 0.0, 0.0
    for k in range(n):
        y[k] = flow + load + 0.02 * random.standard_normal()
        integral += -y[k] / 25.0
        u[k] = command = 0.2 * -y[k] + integral
        position = command if abs(command - position) > band else position
        load += wander * random.standard_normal()
        flow += (2.0 * position + 0.7 - flow) / 3.0
    return Recording(np.arange(float(n)), 50.0 + u, 100.0 + y)


def seen(recording):
    return waiting_of(dataset_of(recording))


def searched(recording):
    context = bench_of(dataset_of(recording))
    return catalogue(base_of(context, ("offset",), 0).best, context.coarse)


def test_the_pv_of_a_valve_that_sticks_waits():
    found = seen(flow_loop(band=1.0))
    assert found.sticks
    assert not found.follows
    # From slip to slip the command travels a band; Kp K = 0.4 of it comes back at once, when the flow answers.
    assert max(found.travels) == pytest.approx(0.6, rel=0.2)


@pytest.mark.parametrize(("band", "slow"), [(1.0, False), (0.0, True)])
def test_the_cycle_of_a_valve_that_sticks_is_no_slow_wave_of_the_surroundings(band, slow):
    """A few of its periods in a record would be."""
    assert ("ambient:slow wave" in {effect.key for effect in searched(flow_loop(band))}) is slow


@pytest.mark.parametrize("wander", [0.0, 0.03])
def test_that_of_a_free_valve_does_not(wander):
    assert not seen(flow_loop(band=0.0, wander=wander)).sticks


@pytest.mark.long  # a valve of the independent generator in a PI loop is named too, see test_closed_loops
def test_it_is_named():
    assert SLIPS & {effect.name for effect in diagnose(flow_loop(band=1.0)).effects}


@pytest.fixture(scope="module")
def following():
    """Return a record whose PV follows every move of the output."""
    t = np.arange(900.0)
    u = np.sin(t / 40.0) + 0.6 * np.sin(t / 17.0)
    return Recording(t, 50.0 + u, 100.0 + 2.0 * u + 0.05 * np.random.default_rng(2).standard_normal(t.size))


def test_a_pv_that_follows_every_move_has_no_friction(following):
    u, found = following.output, seen(following)
    assert (found.sticks, found.follows) == (False, True)
    assert found.largest_step == pytest.approx(0.08 * np.ptp(u), rel=0.02)
    assert not SLIPS & {effect.name for effect in searched(following)}


@pytest.mark.long  # the test above shows that friction is not searched for
def test_none_is_named_where_the_pv_follows(following):
    assert not SLIPS & {effect.name for effect in diagnose(following).effects}


def test_play_of_half_the_swing_is_not_taken_for_following():
    u, x = np.sin(np.arange(900.0) / 40.0), 0.0
    position = np.zeros(u.size)
    for k, command in enumerate(u):
        x = min(max(x, command - 0.5), command + 0.5)
        position[k] = x
    assert not waiting(u, position, 0.0).follows


def test_nothing_is_seen_where_no_controller_moves_the_output():
    u = np.repeat([0.0, 1.0, -1.0, 1.0, 0.0], 100)
    assert seen(Recording(np.arange(500.0), u, np.roll(u, 3))) == NOTHING


def test_a_pv_that_never_moves_shows_nothing():
    u = np.cumsum(np.random.default_rng(3).standard_normal(400))
    assert waiting(u, np.full(400, 7.0), 0.0) == NOTHING
