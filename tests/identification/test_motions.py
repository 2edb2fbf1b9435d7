"""Motions under a held input, judged by the matrix exponential."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.model.step_responses import (
    EqualLags,
    Integrator,
    Lag,
    LaggedIntegrator,
    Pair,
    PairAndLag,
    UnstableLag,
)
from autotuner.core.model.zoh_input import HeldInput, accumulate, accumulate_states, held_input, unit_step

# Each motion with x' = A x + B u, y = C x, written down from its differential equation.
CASES = {
    "lag": (Lag(3.0), [[-1 / 3]], [1 / 3], [[1.0]]),
    "lag with zero": (Lag(3.0, zero=True), [[-1 / 3]], [1 / 3], None),
    "overdamped": (Pair(24.0, 11.0), [[0, 1], [-1 / 24, -11 / 24]], [0, 1 / 24], [[1.0, 0.0]]),
    "equal lags": (Pair(64.0, 16.0), [[0, 1], [-1 / 64, -1 / 4]], [0, 1 / 64], [[1.0, 0.0]]),
    "stiff": (Pair(0.008, 8.001), [[0, 1], [-125.0, -8001 / 8]], [0, 125.0], [[1.0, 0.0]]),
    "underdamped": (Pair(9.0, 2.4), [[0, 1], [-1 / 9, -2.4 / 9]], [0, 1 / 9], [[1.0, 0.0]]),
    "zero": (Pair(24.0, 11.0, zero=True), [[0, 1], [-1 / 24, -11 / 24]], [0, 1 / 24], [[1.0, 0.0], [0.0, 1.0]]),
    "three equal lags": (
        EqualLags(3.0, 3),
        [[-1 / 3, 0, 0], [1 / 3, -1 / 3, 0], [0, 1 / 3, -1 / 3]],
        [1 / 3, 0, 0],
        [[0.0, 0.0, 1.0]],
    ),
    "pair and lag": (
        PairAndLag(9.0, 2.4, 4.0),
        [[0, 1, 0], [-1 / 9, -2.4 / 9, 0], [1 / 4, 0, -1 / 4]],
        [0, 1 / 9, 0],
        [[0.0, 0.0, 1.0]],
    ),
    "integrator": (Integrator(), [[0.0]], [1.0], [[1.0]]),
    "lagged integrator": (LaggedIntegrator(2.0), [[0, 1], [0, -0.5]], [0, 0.5], [[1.0, 0.0]]),
    "unstable": (UnstableLag(20.0, 57.3), [[0.05]], [0.05], [[1.0]]),
}


def by_matrix_exponential(A, B, times, levels, when):
    """States at `when`, from rest, stepping from event to event."""
    A, B = np.atleast_2d(np.array(A, float)), np.array(B, float)
    n = B.size
    x, last, level, states = np.zeros(n), min(times[0], when[0]), 0.0, []
    changes = dict(zip(times.tolist(), levels.tolist(), strict=True))
    for event in np.unique(np.concatenate((times, when))):
        big = np.zeros((n + 1, n + 1))
        big[:n, :n], big[:n, n] = A, B * level
        x, last = (scipy.linalg.expm(big * (event - last)) @ np.append(x, 1.0))[:n], event
        level = changes.get(event, level)
        if event in when:
            states.append(x)
    return np.array(states)


@pytest.fixture(scope="module")
def course():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 60.0, 300))
    output = np.repeat(rng.normal(size=15), 20)
    return t, held_input(t, output), t - 1.234


@pytest.mark.parametrize("name", [name for name in CASES if name not in {"unstable", "lag with zero"}])
def test_forced_response_at_irregular_samples(course, name):
    motion, A, B, C = CASES[name]
    _, held, when = course
    states = by_matrix_exponential(A, B, held.times, held.levels, when)
    columns, _ = motion.forced(held, when)
    for column, row in zip(columns, C, strict=True):
        expected = states @ np.array(row)
        assert np.abs(column - expected).max() <= 1e-10 * np.abs(states @ np.array(C[0])).max()


def test_unstable_motion_differs_from_the_one_from_rest_by_its_free_motion(course):
    motion, A, B, _ = CASES["unstable"]
    t, held, when = course
    expected = by_matrix_exponential(A, B, held.times, held.levels, when)[:, 0]
    (column,), _ = motion.forced(held, when)
    (free,) = motion.free(t)
    left = expected - column - (expected[-1] - column[-1]) / free[-1] * free
    assert np.abs(left).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("name", list(CASES))
def test_slopes_are_those_of_the_response(course, name):
    motion = CASES[name][0]
    _, held, _ = course
    when = np.linspace(0.5, 55.0, 4001)
    away = np.min(np.abs(when[:, None] - held.times[None, :]), axis=1) > 1e-3
    ahead, behind = motion.forced(held, when + 1e-6)[0], motion.forced(held, when - 1e-6)[0]
    for k, slope in enumerate(motion.forced(held, when)[1]):
        numeric = (ahead[k] - behind[k]) / 2e-6
        scale = np.abs(numeric[away]).max()
        assert np.abs(slope - numeric)[away].max() <= 2e-5 * scale


@pytest.mark.parametrize("name", list(CASES))
def test_inputs_that_change_together_are_each_answered_as_by_itself(course, name):
    motion = CASES[name][0]
    _, held, when = course
    levels = np.array([held.levels, np.roll(held.levels[::-1], 1), np.zeros_like(held.levels)])
    together = motion.forced(HeldInput(held.times, levels), when)
    for k, row in enumerate(levels):
        for those, single in zip(together, motion.forced(HeldInput(held.times, row), when), strict=True):
            assert np.array_equal(np.array(those)[:, k], np.array(single))


@pytest.mark.parametrize("name", list(CASES))
def test_no_input_has_no_answer(course, name):
    _, held, when = course
    columns, slopes = CASES[name][0].forced(HeldInput(held.times, np.zeros((0, held.times.size))), when)
    assert {column.shape for column in (*columns, *slopes)} == {(0, when.size)}


@pytest.mark.parametrize("name", [name for name in CASES if name not in {"integrator", "unstable", "stiff"}])
def test_free_motions_solve_the_homogeneous_equation(name):
    motion, A, _, _ = CASES[name]
    poles = np.sort_complex(np.linalg.eigvals(np.atleast_2d(np.array(A, float))))
    t = np.linspace(0.0, 20.0, 401)
    # Every free motion is a sum of modes: appended to a basis of the modes, it adds nothing.
    powers = {"equal lags": (1,), "three equal lags": (1, 2)}.get(name, ())
    modes = [np.exp(p * t) for p in poles] + [t**k * np.exp(poles[0] * t) for k in powers]
    basis = np.column_stack([part for mode in modes for part in (mode.real, mode.imag)])
    for column in motion.free(t):
        left = column - basis @ np.linalg.lstsq(basis, column, rcond=None)[0]
        assert np.abs(left).max() <= 1e-9


def test_unit_step_starts_with_the_recording():
    (response,), _ = Lag(2.0).forced(unit_step(0.0), np.array([-1.0, 0.0, 2.0, 20.0]))
    assert response == pytest.approx([0.0, 0.0, 1.0 - np.exp(-1.0), 1.0 - np.exp(-10.0)], abs=1e-14)


def test_held_input_keeps_the_changes_only():
    held = held_input(np.array([1.0, 2.0, 3.0, 5.0, 6.0]), np.array([4.0, 4.0, 7.0, 7.0, 2.0]))
    assert held.times.tolist() == [1.0, 3.0, 6.0]
    assert held.levels.tolist() == [0.0, 3.0, -2.0]
    assert held.steps.tolist() == [0.0, 3.0, -5.0]


numbers = st.lists(st.tuples(*[st.floats(-2.0, 2.0)] * 6), min_size=1, max_size=30)


@given(numbers)
def test_recurrences_equal_their_loops(rows):
    p00, g0 = np.array(rows).T[[0, 4]]
    x, y, a, b = [], [], 0.0, np.zeros(2)
    for row in rows:
        a = row[0] * a + row[4]
        b = np.array([[row[0], row[1]], [row[2], row[3]]]) @ b + np.array(row[4:])
        x.append(a)
        y.append(b)
    scale = 1.0 + np.abs(y).max()
    assert accumulate(p00, g0) == pytest.approx(np.array(x), rel=1e-9, abs=1e-9 * scale)
    pair = accumulate_states(np.array(rows)[:, :4].T.reshape(2, 2, -1), np.array(rows)[:, 4:])
    assert pair == pytest.approx(np.array(y), rel=1e-9, abs=1e-9 * scale)


def test_moves_that_change_no_level_are_left_out():
    times = np.arange(5.0)
    one = HeldInput(times, np.array([0.0, 2.0, 2.0, 0.0, 0.0])).without_repeats()
    both = HeldInput(times, np.array([[0.0, 0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 3.0, 3.0, 3.0]])).without_repeats()
    assert (one.times.tolist(), one.levels.tolist()) == ([0.0, 1.0, 3.0], [0.0, 2.0, 0.0])
    assert both.times.tolist() == [0.0, 2.0, 3.0]
    assert both.levels.tolist() == [[0.0, 0.0, 1.0], [0.0, 3.0, 3.0]]
