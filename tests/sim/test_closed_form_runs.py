"""Relay tests in closed form, one and many at a time, against the general event-driven run and the solved cycle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner_sim import (
    Fopdt,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    cycle_batch,
    find_limit_cycle,
    quick_relay,
    relay_tests,
    run_relay,
    symmetric_relay,
)

lags = st.floats(0.05, 50.0)
parts = st.floats(0.01, 1.0)
ratios = st.floats(0.02, 5.0)


@st.composite
def plants(draw):
    """A plant of each structure, of either sign."""
    K, T, ratio, part = draw(st.floats(0.1, 10.0)), draw(lags), draw(ratios), draw(parts)
    K *= draw(st.sampled_from([1.0, -1.0]))
    return draw(
        st.sampled_from(
            [
                Fopdt(K, T, ratio * T),
                SopdtOverdamped(K, T, part * T, ratio * T),
                SopdtOverdamped(K, T, T, ratio * T),
                SopdtUnderdamped(K, T * T, 2.0 * max(part, 0.05) * 0.999 * T, ratio * T),
            ]
        )
    )


@st.composite
def relays(draw, plant):
    """A relay with bias and dead zone that the plant can cross."""
    bias = draw(st.floats(-0.4, 0.4))
    dead_zone = draw(st.sampled_from([0.0, 0.01, 0.3])) * abs(plant.K) * (1.0 - abs(bias))
    return Relay(bias - 1.0, bias + 1.0, hysteresis=dead_zone, direct=plant.K > 0.0)


def test_first_order_by_hand():
    """D/T = ln 2: the amplitude is K h/2, the half period T ln 3, the first switch one dead time after the start."""
    run = quick_relay(Fopdt(3.0, 5.0, 5.0 * math.log(2.0)), symmetric_relay(2.0), 5)
    first, half = 5.0 * math.log(2.0), 5.0 * math.log(3.0)
    assert run.switches_s == pytest.approx([first + k * half for k in range(5)], rel=1e-14)
    assert run.turns == pytest.approx([3.0, -3.0, 3.0, -3.0], rel=1e-14)
    assert (run.period_s, run.peak) == pytest.approx((2.0 * half, 3.0), rel=1e-14)


@given(st.data())
def test_one_run_is_the_general_one(data):
    plant = data.draw(plants())
    relay = data.draw(relays(plant))
    quick = quick_relay(plant, relay, 12)
    run = run_relay(plant, relay, 1e9, max_switches=12)
    assert quick.switches_s == pytest.approx(run.times_s[1:], rel=1e-9)
    assert quick.turns == pytest.approx(furthest(run), rel=1e-8, abs=1e-12 * abs(plant.K))


def furthest(run):
    """The highest PV after a switch that was passed upwards, the lowest after one that was passed downwards."""
    times, threshold = run.times_s, run.relay.threshold
    ways = [threshold(is_high=level == run.relay.high)[1] for level in run.levels[:-1]]
    spans = zip(times[1:], times[2:], ways, strict=False)
    return [run.extremes(begin, end)[1 if way > 0 else 0] for begin, end, way in spans]


RINGING = {
    "one switch on its way, turns once more": (SopdtUnderdamped(1.0, 100.0, 4.0, 30.0), symmetric_relay()),
    "three on their way": (SopdtUnderdamped(2.0, 100.0, 2.0, 70.0), symmetric_relay()),
    "three on their way, dead zone, bias": (SopdtUnderdamped(2.0, 9.0, 0.6, 20.0), Relay(-1.0, 1.3, 0.1, 0.2)),
    "dozens of turns": (SopdtUnderdamped(-1.0, 1.0, 0.05, 80.0), Relay(-1.0, 1.0, direct=False)),
    "a dead zone only the ringing reaches": (SopdtUnderdamped(1.0, 1.0, 0.1, 2.0), symmetric_relay(hysteresis=1.5)),
    "all but a double pole, long dead time": (SopdtUnderdamped(1.0, 1.0, 1.98, 30.0), symmetric_relay()),
    "rest forbids the first level": (SopdtUnderdamped(1.0, 1.0, 0.3, 5.0), Relay(-1.0, 1.0, -0.5, 0.1)),
    "a level that leads to the threshold": (SopdtUnderdamped(1.0, 1.0, 0.3, 5.0), Relay(-1.0, 1.0, 0.8, 0.2)),
}


@pytest.mark.parametrize(("plant", "relay"), RINGING.values(), ids=RINGING)
def test_a_plant_that_rings_while_switches_are_on_their_way(plant, relay):
    quick, run = quick_relay(plant, relay, 20), run_relay(plant, relay, 1e5, max_switches=20)
    assert quick.switches_s == pytest.approx(run.times_s[1:], rel=1e-12)
    assert quick.turns == pytest.approx(furthest(run), rel=1e-11)
    lowest, highest = run.extremes(run.times_s[-3], run.times_s[-1])
    truth = run.times_s[-1] - run.times_s[-3], (highest - lowest) / 2.0
    assert (quick.period_s, quick.peak) == pytest.approx(truth, rel=1e-12)


@pytest.mark.parametrize("plant", [Fopdt(1.0, 10.0, 2.0), SopdtOverdamped(1.0, 10.0, 3.0, 2.0)])
def test_a_rest_that_forbids_the_high_level_begins_at_the_low_one(plant):
    relay = Relay(-1.0, 1.0, reference=-0.3, hysteresis=0.1)
    run = run_relay(plant, relay, 1e5, max_switches=9)
    assert run.levels[0] == -1.0
    quick = quick_relay(plant, relay, 9)
    assert quick.switches_s == pytest.approx(run.times_s[1:], rel=1e-12)
    assert quick.turns == pytest.approx(furthest(run), rel=1e-11)


@pytest.mark.parametrize("switches", [3, 4, 19, 20])
def test_a_run_that_has_settled_goes_on_in_equal_steps(switches):
    plant = SopdtOverdamped(1.0, 10.0, 1.0, 2.0)
    quick = quick_relay(plant, Relay(-1.0, 2.0, hysteresis=0.05), switches)
    run = run_relay(plant, Relay(-1.0, 2.0, hysteresis=0.05), 1e6, max_switches=switches)
    assert len(quick.switches_s) == switches
    assert len(quick.turns) == switches - 1
    assert quick.switches_s == pytest.approx(run.times_s[1:], rel=1e-13)


@pytest.mark.parametrize("T2", [1e-6, 1e-3, 1.0, 9.99999999, 10.0])
def test_poles_far_apart_and_equal_lose_no_digits(T2):
    cycle = find_limit_cycle(SopdtOverdamped(2.0, 10.0, T2, 3.0), symmetric_relay(hysteresis=0.1))
    run = quick_relay(SopdtOverdamped(2.0, 10.0, T2, 3.0), symmetric_relay(hysteresis=0.1), 60)
    assert (run.period_s, run.peak) == pytest.approx((cycle.period_s, cycle.peak), rel=1e-12)


def test_a_second_lag_of_nothing_is_none():
    one = quick_relay(SopdtOverdamped(1.0, 10.0, 0.0, 2.0), symmetric_relay(), 6)
    assert one == quick_relay(Fopdt(1.0, 10.0, 2.0), symmetric_relay(), 6)


@pytest.mark.parametrize(
    ("plant", "relay"),
    [
        (Fopdt(1.0, 10.0, 0.0), symmetric_relay(hysteresis=0.1)),
        (Fopdt(1.0, 10.0, 2.0), Relay(0.5, 1.0)),
        (Fopdt(1.0, 10.0, 2.0), symmetric_relay(hysteresis=1.5)),
        (Fopdt(-1.0, 10.0, 2.0), symmetric_relay()),
        (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), symmetric_relay(hysteresis=1.9)),
        (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), Relay(-1.0, 0.0)),
        (SopdtUnderdamped(1.0, 1.0, 1.4, 3.0), Relay(-1.0, 1.0, reference=-0.1, hysteresis=1.0)),
    ],
    ids=["no dead time", "one-sided", "dead zone out of reach", "wrong sign", "rings no further", "rest", "other way"],
)
def test_where_there_is_no_answer_it_says_so(plant, relay):
    assert quick_relay(plant, relay, 6) is None


def coefficients(plant):
    if isinstance(plant, Fopdt):
        return 0.0, plant.T
    if isinstance(plant, SopdtUnderdamped):
        return plant.m, plant.n
    return plant.T1 * plant.T2, plant.T1 + plant.T2


@given(st.data())
def test_a_batch_is_many_single_runs(data):
    cases = [(plant, data.draw(relays(plant))) for plant in data.draw(st.lists(plants(), min_size=1, max_size=6))]
    rows = [(p.K, *coefficients(p), p.D, r.low, r.high, r.reference, r.hysteresis) for p, r in cases]
    batch = cycle_batch(relay_tests(*np.array(rows).T), switches=12)
    for i, (plant, relay) in enumerate(cases):
        quick = quick_relay(plant, relay, 12)
        if quick is None:
            assert np.isnan(batch.period_s[i])
            continue
        assert batch.period_s[i] == pytest.approx(quick.period_s, rel=1e-8)
        assert batch.high_s[i] == pytest.approx(quick.switches_s[-2] - quick.switches_s[-3], rel=1e-8)
        assert batch.peak[i] == pytest.approx(quick.peak, rel=1e-8)


def test_the_tenth_period_of_a_batch_is_exact_before_it_is_steady():
    """Lightly damped and with little dead time, so that the last period is not yet like the one before."""
    rng = np.random.default_rng(5)
    K, T, part, ratio = rng.uniform(0.2, 5.0, 24), 10.0 ** rng.uniform(-1.0, 1.0, 24), rng.uniform(0.1, 0.9, 24), 0.1
    kinds = [
        (SopdtOverdamped, part * T * T, (1.0 + part) * T, lambda i: (T[i], part[i] * T[i])),
        (SopdtUnderdamped, T * T, 2.0 * part * T, lambda i: (T[i] * T[i], 2.0 * part[i] * T[i])),
    ]
    for kind, m, n, parameters in kinds:
        batch = cycle_batch(relay_tests(K, m, n, ratio * T, -1.0, 1.4, hysteresis=0.02 * K))
        for i in range(24):
            plant, relay = kind(K[i], *parameters(i), ratio * T[i]), Relay(-1.0, 1.4, hysteresis=0.02 * K[i])
            run, quick = run_relay(plant, relay, 1e9, max_switches=20), quick_relay(plant, relay, 20)
            lowest, highest = run.extremes(run.times_s[-3], run.times_s[-1])
            truth = run.times_s[-1] - run.times_s[-3], (highest - lowest) / 2.0
            assert (batch.period_s[i], batch.peak[i]) == pytest.approx(truth, rel=1e-12)
            assert (quick.period_s, quick.peak) == pytest.approx(truth, rel=1e-12)


def random_tests(rng, size):
    """Plants of second order of either sign with relays of every kind, dead times from a hundredth of a lag on."""
    T, zeta = 10.0 ** rng.uniform(-1.0, 1.0, size), 10.0 ** rng.uniform(-1.3, 0.8, size)
    zeta[::9] = 1.0
    K, D = rng.choice([-1.0, 1.0], size) * rng.uniform(0.2, 5.0, size), T * 10.0 ** rng.uniform(-2.0, 1.0, size)
    bias, reference = (rng.choice([0.0, 0.3, -0.4], size) for _ in range(2))
    hysteresis = rng.choice([0.0, 0.003, 0.2], size) * np.abs(K)
    return relay_tests(K, T * T, 2.0 * zeta * T, D, bias - 1.0, bias + 1.0, reference * K / 2.0, hysteresis)


def plants_and_relays(tests):
    """The same one by one."""
    for K, m, n, D, low, high, reference, hysteresis in zip(*(column.tolist() for column in tests), strict=True):
        split = math.sqrt(max(n * n - 4.0 * m, 0.0)) / 2.0
        damped = SopdtOverdamped(K, n / 2.0 + split, n / 2.0 - split, D)
        plant = SopdtUnderdamped(K, m, n, D) if n * n < 4.0 * m else damped
        yield plant, Relay(low, high, reference, hysteresis, direct=K > 0.0)


@pytest.mark.parametrize("switches", [4, 6, 20, 80])
def test_a_thousand_plants_and_relays_are_a_thousand_single_runs(switches):
    """Those that leave a batch early because they have settled, too, and those for which another method is asked."""
    tests = random_tests(np.random.default_rng(switches), 1000)
    batch = cycle_batch(tests, switches)
    runs = [quick_relay(plant, relay, switches) for plant, relay in plants_and_relays(tests)]
    assert np.isnan(batch.period_s).tolist() == [run is None for run in runs]
    known = np.isfinite(batch.period_s)
    periods, peaks = np.array([(run.period_s, run.peak) for run in runs if run is not None]).T
    assert batch.period_s[known] == pytest.approx(periods, rel=1e-11)
    assert batch.peak[known] == pytest.approx(peaks, rel=1e-11)


@pytest.mark.parametrize("switches", [4, 20, 60])
def test_plants_and_relays_at_random_are_as_in_the_general_run(switches):
    tests = random_tests(np.random.default_rng(100 + switches), 40)
    batch = cycle_batch(tests, switches)
    assert np.count_nonzero(np.isfinite(batch.period_s)) > 30
    for i, (plant, relay) in enumerate(plants_and_relays(tests)):
        if np.isfinite(batch.period_s[i]):
            run = run_relay(plant, relay, 1e9, max_switches=switches)
            lowest, highest = run.extremes(run.times_s[-3], run.times_s[-1])
            truth = run.times_s[-1] - run.times_s[-3], (highest - lowest) / 2.0
            assert (batch.period_s[i], batch.peak[i]) == pytest.approx(truth, rel=1e-11)


def test_a_batch_of_settled_cycles_with_their_fundamentals():
    """More plants than one sweep holds, of all three kinds in turn, against cycles solved for one by one."""
    rng = np.random.default_rng(4)
    size = 13_000
    K, T, D, part = rng.uniform(0.1, 5.0, size), rng.uniform(1.0, 20.0, size), rng.uniform(1.0, 5.0, size), 0.3
    kind = np.arange(size) % 3
    m = np.choose(kind, (0.0 * T, part * T**2, T**2))
    n = np.choose(kind, (T, (1.0 + part) * T, 1.6 * T))
    batch = cycle_batch(relay_tests(K, m, n, D, -1.0, 1.5, hysteresis=0.05 * K), switches=200)
    for i in range(0, size, 1003):
        plant = {
            0: lambda i=i: Fopdt(K[i], T[i], D[i]),
            1: lambda i=i: SopdtOverdamped(K[i], T[i], part * T[i], D[i]),
            2: lambda i=i: SopdtUnderdamped(K[i], m[i], n[i], D[i]),
        }[kind[i]]()
        cycle = find_limit_cycle(plant, Relay(-1.0, 1.5, hysteresis=0.05 * K[i]))
        found = (batch.high_s[i], batch.low_s[i], batch.peak[i], batch.fundamental[i])
        assert found == pytest.approx((cycle.high_s, cycle.low_s, cycle.peak, cycle.fundamental), rel=1e-10)


def test_a_batch_of_plants_that_ring_while_switches_are_on_their_way():
    cases = list(RINGING.values())
    rows = [(p.K, p.m, p.n, p.D, r.low, r.high, r.reference, r.hysteresis) for p, r in cases]
    batch = cycle_batch(relay_tests(*np.array(rows).T), switches=20)
    for i, (plant, relay) in enumerate(cases):
        run = run_relay(plant, relay, 1e5, max_switches=20)
        order = slice(None, None, -1 if run.levels[0] == relay.low else 1)
        expected = *np.diff(run.times_s)[-2:][order], *furthest(run)[-2:][order]
        found = batch.high_s[i], batch.low_s[i], batch.after_rise[i], batch.after_fall[i]
        assert found == pytest.approx(expected, rel=1e-11)
    assert not batch.turns_once.any()


def test_a_batch_knows_which_plants_turn_once():
    """Half a turn of the free motion is 3.2 s: with a dead time over that the PV must have turned before an arrival."""
    batch = cycle_batch(relay_tests(1.0, [0.0, 1.0, 1.0, 1.0], [1.0, 3.0, 0.4, 0.4], [9.0, 9.0, 0.3, 3.3]))
    assert batch.turns_once.tolist() == [True, True, True, False]


def test_a_batch_where_rest_forbids_the_high_level():
    m, n = [0.0, 30.0, 30.0], [10.0, 13.0, 4.0]
    batch = cycle_batch(relay_tests(1.0, m, n, 2.0, -1.0, 1.2, -0.3, 0.1), switches=40)
    plants = Fopdt(1.0, 10.0, 2.0), SopdtOverdamped(1.0, 10.0, 3.0, 2.0), SopdtUnderdamped(1.0, 30.0, 4.0, 2.0)
    for i, plant in enumerate(plants):
        run = run_relay(plant, Relay(-1.0, 1.2, -0.3, 0.1), 1e5, max_switches=40)
        assert (batch.low_s[i], batch.high_s[i]) == pytest.approx(np.diff(run.times_s)[-2:], rel=1e-11)
        assert (batch.after_fall[i], batch.after_rise[i]) == pytest.approx(furthest(run)[-2:], rel=1e-11)


def test_a_batch_marks_what_it_cannot_do():
    K, m, n, D = [1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0], [5.0, 5.0, 0.4, 0.4], [1.0, 0.0, 3.0, 3.0]
    batch = cycle_batch(relay_tests(K, m, n, D, hysteresis=[0.0, 0.0, 0.0, 1.9]))
    assert np.isfinite(batch.period_s).tolist() == [True, False, True, False]
    assert np.isfinite(batch.fundamental).tolist() == [True, False, True, False]
    none = cycle_batch(relay_tests([1.0], 0.0, 5.0, 1.0, low=0.5))
    assert np.isnan(none.peak).all()
