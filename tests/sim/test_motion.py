"""Exact motion under a constant input, against zero-order-hold matrices of the transfer function."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as st

from autotuner_sim import (
    PLANTS,
    Fopdt,
    Integrating,
    InverseResponse,
    LagChain,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)

ALL = [
    Fopdt(2.0, 10.0, 1.5),
    SopdtOverdamped(1.0, 10.0, 2.0, 4.0),
    SopdtOverdamped(1.5, 4.2, 7.5, 5.0),
    SopdtOverdamped(1.0, 3.0, 3.0, 1.0),
    SopdtOverdamped(1.0, 60.0, 0.02, 5.0),
    SopdtUnderdamped(1.0, 1.0, 0.4, 3.0),
    SopdtUnderdamped(3.5, 9.4, 3.7, 7.0),
    Integrating(0.3, 3.0, 2.0),
    UnstableFopdt(1.0, 10.0, 2.0),
    InverseResponse(1.0, 5.0, 3.0, 1.0, 2.0),
    InverseResponse(-2.0, 1.0, 4.0, 2.5, 0.0),
    LagChain(1.0, (1.0, 1.0, 1.0, 1.0), 0.3),
    LagChain(2.0, (5.0, 0.1, 1.0, 1.001), 0.3),
]
positive = st.floats(0.01, 100.0)


@pytest.mark.parametrize("plant", ALL, ids=str)
def test_matches_the_zero_order_hold_of_its_transfer_function(plant, oracle):
    inputs = np.random.default_rng(5).normal(size=60)
    dt = 0.37
    motion = plant.motion()
    x, ours = motion.rest, []
    for u in inputs:
        x = motion.move(x, u, dt)
        ours.append(motion.output(x))
    expected = oracle.held_response(plant, inputs, dt)
    assert np.allclose(ours, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("plant", ALL, ids=str)
def test_the_pv_is_monotone_between_neighbouring_turning_points(plant):
    random = np.random.default_rng(11)
    motion = plant.motion()
    span = 8.0 * motion.time_scale_s
    turns = 0
    for _ in range(20):
        x = tuple(random.normal(size=len(motion.rest)).tolist())
        u = float(random.normal())
        ends = [0.0, *motion.turning_points(x, u, span), span]
        turns += len(ends) - 2
        assert ends == sorted(ends)
        for low, high in pairwise(ends):
            pv = np.array([motion.output(motion.move(x, u, s)) for s in np.linspace(low, high, 60).tolist()])
            steps = np.diff(pv)
            tolerance = 1e-12 * np.abs(pv).max()
            assert np.all(steps >= -tolerance) or np.all(steps <= tolerance)
    assert (turns > 0) == (len(motion.rest) > 1)


@given(plant=st.sampled_from(ALL), u=st.floats(-3, 3), first=st.floats(0.0, 30.0), second=st.floats(0.0, 30.0))
def test_two_spans_make_one(plant, u, first, second):
    motion = plant.motion()
    start = motion.move(motion.rest, 0.7, 2.0)
    at_once = motion.output(motion.move(start, u, first + second))
    in_two = motion.output(motion.move(motion.move(start, u, first), u, second))
    assert math.isclose(at_once, in_two, rel_tol=1e-10, abs_tol=1e-10)


@given(T=positive, apart=st.floats(1e-15, 1e-3), h=st.floats(0.01, 50.0))
def test_nearly_equal_lags_lose_no_digits(T, apart, h):
    """The exact derivative of the double lag's step response in one lag bounds what a small difference may do."""
    double = SopdtOverdamped(1.0, T, T, 0.0).motion()
    near = SopdtOverdamped(1.0, T * (1.0 + apart), T, 0.0).motion()
    difference = near.output(near.move(near.rest, 1.0, h)) - double.output(double.move(double.rest, 1.0, h))
    assert abs(difference) <= 0.28 * apart + 1e-15


def test_a_lag_has_moved_63_percent_after_its_time_constant():
    motion = Fopdt(2.0, 10.0, 0.0).motion()
    assert motion.output(motion.move(motion.rest, 3.0, 10.0)) == pytest.approx(6.0 * (1.0 - math.exp(-1.0)), rel=1e-15)


def test_an_inverse_response_starts_the_wrong_way_with_slope_minus_z():
    """At once after a unit step `y' = -K Z/(T1 T2)`, the ratio of the leading coefficients."""
    motion = InverseResponse(2.0, 5.0, 3.0, 1.5, 0.0).motion()
    h = 1e-7
    assert motion.output(motion.move(motion.rest, 1.0, h)) / h == pytest.approx(-2.0 * 1.5 / 15.0, rel=1e-6)


@pytest.mark.parametrize("plant", [p for p in ALL if p.structure not in {"integrating", "unstable_fopdt"}], ids=str)
def test_transfer_at_zero_is_where_a_step_settles(plant):
    motion = plant.motion()
    settled = motion.output(motion.move(motion.rest, 1.0, 60.0 * motion.time_scale_s))
    assert settled == pytest.approx(plant.transfer(0.0 + 0.0j).real, rel=1e-12)


@pytest.mark.parametrize("plant", ALL, ids=str)
@pytest.mark.parametrize("s", [0.7, 2.0])
def test_transfer_is_the_laplace_integral_of_the_step_response(plant, s):
    motion = plant.motion()

    def integrand(t: float) -> float:
        return motion.output(motion.move(motion.rest, 1.0, t)) * math.exp(-s * t)

    breaks = [0.0, 0.01, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 80.0]
    integral = sum(scipy.integrate.quad(integrand, low, high)[0] for low, high in pairwise(breaks))
    assert plant.transfer(complex(s)).real == pytest.approx(s * integral * math.exp(-s * plant.D), rel=1e-9)


@pytest.mark.parametrize("plant", ALL, ids=str)
def test_transfer_turns_by_the_dead_time(plant):
    """Without its dead time the plant has the same gain, and its phase is ahead by `w D`."""
    w = 0.3
    undelayed = dataclasses.replace(plant, D=0.0)
    expected = undelayed.transfer(1j * w) * np.exp(-1j * w * plant.D)
    assert plant.transfer(1j * w) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("structure", "parameters", "named"),
    [
        ("fopdt", {"K": 1.0, "T": 0.0, "D": 1.0}, "fopdt.T"),
        ("fopdt", {"K": 0.0, "T": 1.0, "D": 1.0}, "fopdt.K"),
        ("fopdt", {"K": 1.0, "T": math.nan, "D": 1.0}, "fopdt.T"),
        ("fopdt", {"K": 1.0, "T": 1.0, "D": -1.0}, "fopdt.D"),
        ("sopdt_underdamped", {"K": 1.0, "m": 1.0, "n": 2.0, "D": 1.0}, "sopdt_underdamped.n"),
        ("inverse_response", {"K": 1.0, "T1": 1.0, "T2": 0.0, "Z": 1.0, "D": 1.0}, "inverse_response.T2"),
        ("lag_chain", {"K": 1.0, "lags": (), "D": 1.0}, "lag_chain.lags"),
        ("lag_chain", {"K": 1.0, "lags": (1.0, -1.0), "D": 1.0}, "lag_chain.lags"),
    ],
)
def test_a_plant_that_cannot_exist_cannot_be_made(structure, parameters, named):
    with pytest.raises(ValueError, match=named):
        PLANTS[structure](**parameters)


def test_one_lag_of_zero_is_none():
    two, one = SopdtOverdamped(1.0, 3.0, 0.0, 1.0).motion(), Fopdt(1.0, 3.0, 1.0).motion()
    assert two == one
    assert LagChain(1.0, (3.0,), 1.0).motion() == one
    assert Integrating(2.0, 0.0, 1.0).motion().move((0.0,), 1.0, 3.0) == (6.0,)
