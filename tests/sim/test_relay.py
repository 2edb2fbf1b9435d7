"""The event-driven relay test, against a hand-worked course, a fine fixed-step simulation and what scaling demands."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim import (
    Fopdt,
    Integrating,
    InverseResponse,
    LagChain,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
    run_relay,
    symmetric_relay,
)

positive = st.floats(0.1, 10.0)
plants = st.one_of(
    st.builds(Fopdt, K=positive, T=positive, D=positive),
    st.builds(SopdtOverdamped, K=positive, T1=positive, T2=positive, D=positive),
    st.builds(
        lambda K, m, z, D: SopdtUnderdamped(K, m, 2 * z * math.sqrt(m), D),
        positive,
        positive,
        st.floats(0.05, 0.95),
        positive,
    ),
    st.builds(Integrating, K=positive, T=positive, D=positive),
    st.builds(InverseResponse, K=positive, T1=positive, T2=positive, Z=positive, D=positive),
)


def scaled(plant, time: float = 1.0, gain: float = 1.0):
    """The same plant with another unit of time and of PV."""
    powers = {"K": gain, "m": time**2}
    if plant.structure == "integrating":
        powers["K"] = gain / time
    values = {f.name: getattr(plant, f.name) * powers.get(f.name, time) for f in dataclasses.fields(plant)}
    return type(plant)(**values)


def test_the_course_worked_by_hand():
    """K 2, T 10, D 10 ln 2: the PV leaves 0 at D, is 1 at 2 D, turns towards -2 and is 0 after T ln 1.5."""
    D = 10.0 * math.log(2.0)
    run = run_relay(Fopdt(2.0, 10.0, D), symmetric_relay(), end_s=28.0)
    third = 2.0 * D + 10.0 * math.log(1.5)
    assert run.times_s.tolist() == pytest.approx([0.0, D, third], rel=1e-14)
    assert run.levels.tolist() == [1.0, -1.0, 1.0]
    assert run.pv([D, 2.0 * D, third, third + D]).tolist() == pytest.approx([0.0, 1.0, 0.0, -1.0], abs=1e-14)
    assert run.output([-1.0, 0.0, D, third]).tolist() == [0.0, 1.0, -1.0, 1.0]


FINE = [
    (Fopdt(1.0, 2.0, 1.0), Relay(-1.0, 2.0, reference=0.1, hysteresis=0.2)),
    (Fopdt(-1.5, 2.0, 1.0), Relay(-1.0, 1.0, direct=False)),
    (SopdtOverdamped(1.0, 2.0, 0.5, 1.0), Relay(-1.0, 1.5, hysteresis=0.05)),
    (SopdtUnderdamped(1.0, 1.0, 0.1, 10.0), symmetric_relay(hysteresis=0.1)),
    (SopdtUnderdamped(2.0, 1.0, 0.4, 3.0), Relay(-0.5, 1.0, hysteresis=0.01)),
    (Integrating(0.5, 1.0, 0.5), Relay(-1.0, 1.2, hysteresis=0.05)),
    (UnstableFopdt(1.0, 5.0, 1.0), symmetric_relay(hysteresis=0.01)),
    (InverseResponse(1.0, 2.0, 1.0, 0.7, 0.5), symmetric_relay(hysteresis=0.02)),
    (LagChain(1.0, (0.5, 0.5, 0.5, 1.0), 0.2), Relay(-1.0, 1.3, hysteresis=0.03)),
]


@pytest.mark.parametrize(("plant", "relay"), FINE, ids=str)
def test_switches_where_a_fine_fixed_step_simulation_does(plant, relay, oracle):
    """The fixed-step relay sees each crossing up to one step late; over 40 s those delays add up to a few steps."""
    dt = 1.0 / 1024.0
    expected = oracle.relay_by_euler(plant, relay, end_s=40.0, dt=dt)
    ours = run_relay(plant, relay, end_s=40.0).times_s[1:]
    count = min(len(ours), len(expected))
    assert abs(len(ours) - len(expected)) <= 1
    assert count >= 4
    late = expected[:count] - ours[:count]
    assert np.all(np.abs(late) < 3.0 * dt * np.arange(2, count + 2))


def test_several_switches_travel_through_a_long_dead_time():
    run = run_relay(SopdtUnderdamped(1.0, 1.0, 0.1, 10.0), symmetric_relay(hysteresis=0.1), end_s=400.0)
    on_their_way = [int(np.sum((run.times_s > t - 10.0) & (run.times_s <= t))) for t in run.times_s[40:]]
    assert min(on_their_way) >= 3


@pytest.mark.parametrize(("share", "switches"), [(1.0 - 1e-9, True), (1.0 + 1e-9, False)])
def test_a_crossing_of_a_hair_is_seen_and_a_miss_by_a_hair_is_none(share, switches):
    """The step response's overshoot `1 + exp(-pi z/sqrt(1 - z^2))` just passes the threshold, or just does not."""
    z = 0.3
    overshoot = 1.0 + math.exp(-math.pi * z / math.sqrt(1.0 - z * z))
    relay = Relay(-1.0, 1.0, hysteresis=overshoot * share)
    run = run_relay(SopdtUnderdamped(1.0, 4.0, 4.0 * z, 2.0), relay, end_s=500.0, max_switches=1)
    assert (len(run.times_s) == 2) == switches
    if switches:
        peak_s = 2.0 + math.pi * 2.0 / math.sqrt(1.0 - z * z)
        assert 0.0 < peak_s - run.times_s[1] < 1e-3


@given(plant=plants, hysteresis=st.floats(0.0, 0.2), bias=st.floats(-0.3, 0.3))
def test_the_pv_is_at_the_threshold_at_each_switch(plant, hysteresis, bias):
    relay = Relay(bias - 1.0, bias + 1.0, hysteresis=hysteresis * plant.K)
    run = run_relay(plant, relay, end_s=1e4, max_switches=9)
    pv = run.pv(run.times_s[1:])
    expected = np.where(run.levels[:-1] == relay.high, relay.hysteresis, -relay.hysteresis)
    assert np.allclose(
        pv, expected, rtol=0.0, atol=1e-9 * max(np.abs(run.pv(np.linspace(0.0, run.end_s, 50))).max(), 1e-3)
    )
    assert np.all(np.diff(run.times_s) > 0.0)
    assert set(run.levels[::2]) == {relay.high}


@given(plant=plants, factor=st.floats(1e-3, 1e4), hysteresis=st.floats(0.01, 0.2))
def test_another_unit_of_time_scales_the_times(plant, factor, hysteresis):
    relay = symmetric_relay(1.0, hysteresis * plant.K)
    base = run_relay(plant, relay, end_s=1e4, max_switches=8)
    other = run_relay(scaled(plant, time=factor), relay, end_s=1e4 * factor, max_switches=8)
    assert np.allclose(other.times_s, factor * base.times_s, rtol=1e-8)


@given(plant=plants, factor=st.floats(1e-3, 1e3), hysteresis=st.floats(0.01, 0.2))
def test_another_unit_of_pv_changes_no_time(plant, factor, hysteresis):
    base = run_relay(plant, symmetric_relay(1.0, hysteresis * plant.K), end_s=1e4, max_switches=8)
    other = run_relay(
        scaled(plant, gain=factor), symmetric_relay(1.0, hysteresis * plant.K * factor), end_s=1e4, max_switches=8
    )
    assert np.allclose(other.times_s, base.times_s, rtol=1e-8)


@given(plant=plants, hysteresis=st.floats(0.01, 0.2), bias=st.floats(-0.3, 0.3))
def test_a_mirrored_relay_and_a_reverse_plant_give_the_mirrored_course(plant, hysteresis, bias):
    width = hysteresis * plant.K
    base = run_relay(plant, Relay(bias - 1.0, bias + 1.0, hysteresis=width), end_s=1e4, max_switches=8)
    mirrored = run_relay(
        plant, Relay(-bias - 1.0, -bias + 1.0, hysteresis=width), end_s=1e4, max_switches=8, start_high=False
    )
    reverse = run_relay(
        scaled(plant, gain=-1.0),
        Relay(bias - 1.0, bias + 1.0, hysteresis=width, direct=False),
        end_s=1e4,
        max_switches=8,
    )
    assert np.allclose(mirrored.times_s, base.times_s, rtol=1e-12)
    assert np.allclose(mirrored.levels, -base.levels)
    assert np.allclose(reverse.times_s, base.times_s, rtol=1e-12)


@given(plant=plants, load=st.floats(-0.5, 0.5), load_s=st.floats(0.0, 20.0))
@settings(max_examples=30)
def test_a_load_changes_nothing_before_it_and_then_acts_like_moved_levels(plant, load, load_s):
    """Before the load nothing changes; a load that meets the first output is the same as levels moved by it."""
    relay = symmetric_relay(1.0, 0.1 * plant.K)
    free = run_relay(plant, relay, end_s=1e4, max_switches=6)
    loaded = run_relay(plant, relay, end_s=1e4, max_switches=6, load_s=load_s, load=load)
    before = np.flatnonzero(free.times_s < load_s)
    assert np.allclose(loaded.times_s[before], free.times_s[before], rtol=1e-12)
    moved = run_relay(plant, Relay(load - 1.0, load + 1.0, hysteresis=0.1 * plant.K), end_s=1e4, max_switches=6)
    from_first_output = run_relay(plant, relay, end_s=1e4, max_switches=6, load_s=plant.D, load=load)
    assert np.allclose(from_first_output.times_s, moved.times_s, rtol=1e-9)


def test_levels_on_one_side_of_the_threshold_do_not_oscillate():
    run = run_relay(Fopdt(1.0, 5.0, 1.0), Relay(0.5, 1.0), end_s=1e6)
    assert run.levels.tolist() == [1.0, 0.5]
    assert run.end_s == 1e6
    assert run.pv([1e6])[0] == pytest.approx(0.5)


def test_an_unstable_plant_with_too_much_dead_time_runs_away_and_the_run_still_ends():
    """A symmetric relay holds `K/(T s - 1)` only for `D < T ln 2`."""
    relay = symmetric_relay()
    held = run_relay(UnstableFopdt(1.0, 1.0, 0.99 * math.log(2.0)), relay, end_s=1e5, max_switches=20)
    lost = run_relay(UnstableFopdt(1.0, 1.0, 1.01 * math.log(2.0)), relay, end_s=1e5, max_switches=20)
    assert len(held.times_s) == 21
    assert len(lost.times_s) == 2


def test_an_ideal_relay_without_dead_time_is_refused():
    with pytest.raises(ValueError, match="hysteresis"):
        run_relay(Fopdt(1.0, 1.0, 0.0), symmetric_relay(), end_s=10.0)


def test_without_dead_time_the_hysteresis_makes_the_period():
    """K 1, T 1, eps 0.5: from -0.5 to 0.5 under 1 takes ln(1.5/0.5)."""
    run = run_relay(Fopdt(1.0, 1.0, 0.0), symmetric_relay(1.0, 0.5), end_s=100.0, max_switches=6)
    assert np.diff(run.times_s)[1:].tolist() == pytest.approx([math.log(3.0)] * 5, rel=1e-13)


@pytest.mark.parametrize(
    ("values", "named"),
    [({"low": 1.0, "high": 1.0}, "relay.high"), ({"low": 0.0, "high": 1.0, "hysteresis": -0.1}, "relay.hysteresis")],
)
def test_a_relay_that_cannot_be_is_refused(values, named):
    with pytest.raises(ValueError, match=named):
        Relay(**values)


def test_the_extremes_of_a_run_lie_at_and_between_its_samples():
    """The step response of an underdamped plant peaks at `1 + exp(-pi z/sqrt(1 - z^2))`, which no sample need hit."""
    z = 0.3
    run = run_relay(SopdtUnderdamped(1.0, 4.0, 4.0 * z, 2.0), symmetric_relay(hysteresis=5.0), end_s=60.0)
    assert run.extremes(0.0, 60.0) == pytest.approx(
        (0.0, 1.0 + math.exp(-math.pi * z / math.sqrt(1.0 - z * z))), rel=1e-14
    )
    assert run.extremes(0.0, 2.0) == (0.0, 0.0)
    t = np.linspace(3.0, 9.0, 10001)
    lowest, highest = run.extremes(3.0, 9.0)
    assert (lowest, highest) == pytest.approx((run.pv(t).min(), run.pv(t).max()), rel=1e-6)
    assert lowest <= run.pv(t).min()
    assert highest >= run.pv(t).max()
