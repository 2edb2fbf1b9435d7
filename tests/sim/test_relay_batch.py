"""Relay tests by the compiled kernel against the general event-driven run, solved limit cycles and closed forms."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import autotuner_sim
from autotuner_sim import (
    Fopdt,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    find_limit_cycle,
    run_relay,
    symmetric_relay,
)
from autotuner_sim.relay.batch import (
    coefficients,
    relay_test,
    relay_tests,
    run_relay_tests,
    run_sampled_relay_tests,
)
from benchmarks.latency import simulation

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


def simulated(plant, relay, switches=20):
    """The first row of a batch of one: switches, period, lowest and highest PV."""
    batch = run_relay_tests(relay_test(plant, relay), switches)
    return batch.switches_s[0], batch.period_s[0], batch.lowest[0], batch.highest[0]


def expected(plant, relay, switches=20):
    """The same by the general run."""
    run = run_relay(plant, relay, 1e9, max_switches=switches)
    times = run.times_s[1:]
    return times, times[-1] - times[-3], *run.extremes(times[-3], times[-1])


def assert_same(plant, relay, switches=20, rel=1e-12):
    found, truth = simulated(plant, relay, switches), expected(plant, relay, switches)
    assert found[0] == pytest.approx(truth[0], rel=rel)
    assert found[1] == pytest.approx(truth[1], rel=rel)
    assert found[2:] == pytest.approx(truth[2:], rel=rel, abs=rel * (truth[3] - truth[2]))


def test_first_order_by_hand():
    """D/T = ln 2: the amplitude is K h/2, the half period T ln 3, the first switch one dead time after the start."""
    times, period_s, lowest, highest = simulated(Fopdt(3.0, 5.0, 5.0 * math.log(2.0)), symmetric_relay(2.0), 5)
    first, half = 5.0 * math.log(2.0), 5.0 * math.log(3.0)
    assert times == pytest.approx([first + k * half for k in range(5)], rel=1e-14)
    assert (lowest, highest, period_s) == pytest.approx((-3.0, 3.0, 2.0 * half), rel=1e-14)


@given(st.data())
def test_one_run_is_the_general_one(data):
    plant = data.draw(plants())
    assert_same(plant, data.draw(relays(plant)), 12, rel=1e-9)


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
    assert_same(plant, relay)
    assert not run_relay_tests(relay_test(plant, relay)).turns_once[0]


@pytest.mark.parametrize(
    "plant", [Fopdt(1.0, 10.0, 2.0), SopdtOverdamped(1.0, 10.0, 3.0, 2.0), SopdtUnderdamped(1.0, 30.0, 4.0, 2.0)]
)
def test_a_rest_that_forbids_the_high_level_begins_at_the_low_one(plant):
    relay = Relay(-1.0, 1.2, reference=-0.3, hysteresis=0.1)
    assert run_relay(plant, relay, 1e5, max_switches=9).levels[0] == -1.0
    assert not run_relay_tests(relay_test(plant, relay)).starts_high[0]
    assert_same(plant, relay, 9)


@pytest.mark.parametrize("plant", [Fopdt(1.0, 1.0, 0.0), SopdtOverdamped(1.0, 10.0, 1.0, 0.0)])
def test_without_dead_time_the_dead_zone_makes_the_period(plant):
    assert_same(plant, Relay(-1.0, 1.5, hysteresis=0.3), 9)


@pytest.mark.parametrize("T2", [1e-6, 1e-3, 1.0, 9.99999999, 10.0])
def test_poles_far_apart_and_equal_lose_no_digits(T2):
    plant, relay = SopdtOverdamped(2.0, 10.0, T2, 3.0), symmetric_relay(hysteresis=0.1)
    cycle = find_limit_cycle(plant, relay)
    _, period_s, lowest, highest = simulated(plant, relay, 60)
    assert (period_s, (highest - lowest) / 2.0) == pytest.approx((cycle.period_s, cycle.peak), rel=1e-12)


def test_a_second_lag_of_nothing_is_none():
    one = simulated(SopdtOverdamped(1.0, 10.0, 0.0, 2.0), symmetric_relay(), 6)
    assert one[0].tolist() == simulated(Fopdt(1.0, 10.0, 2.0), symmetric_relay(), 6)[0].tolist()


NEVER = {
    "no dead time": (Fopdt(1.0, 10.0, 0.0), symmetric_relay()),
    "one-sided": (Fopdt(1.0, 10.0, 2.0), Relay(0.5, 1.0)),
    "dead zone out of reach": (Fopdt(1.0, 10.0, 2.0), symmetric_relay(hysteresis=1.5)),
    "rings no further": (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), symmetric_relay(hysteresis=1.9)),
    "rest": (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), Relay(-1.0, 0.0)),
    "other way": (SopdtUnderdamped(1.0, 1.0, 1.4, 3.0), Relay(-1.0, 1.0, reference=-0.1, hysteresis=1.0)),
}


@pytest.mark.parametrize(("plant", "relay"), NEVER.values(), ids=NEVER)
def test_a_test_that_does_not_oscillate_has_no_period(plant, relay):
    batch = run_relay_tests(relay_test(plant, relay), 6)
    assert np.isnan([batch.period_s, batch.peak, batch.fundamental, batch.high_s]).all()
    if plant.D > 0.0:
        switches_s = run_relay(plant, relay, 1e6, max_switches=6).times_s[1:]
        assert batch.switches_s[0][: switches_s.size] == pytest.approx(switches_s)
        assert np.isnan(batch.switches_s[0][switches_s.size :]).all()


WRONG = {
    "finite": {"K": math.nan},
    "K must not be 0": {"K": 0.0},
    "n must be positive": {"n": [1.0, 0.0]},
    "must not be negative": {"hysteresis": -0.1},
    "high must exceed low": {"high": -1.0},
}


@pytest.mark.parametrize(("words", "values"), WRONG.items(), ids=WRONG)
def test_values_that_cannot_be_are_refused(words, values):
    with pytest.raises(ValueError, match=words):
        relay_tests(**{"K": 1.0, "m": 0.0, "n": 10.0, "D": 2.0, **values})


def test_a_relay_against_the_plant_and_too_few_switches_are_refused():
    with pytest.raises(ValueError, match=r"relay\.direct must be False"):
        relay_test(Fopdt(-1.0, 10.0, 2.0), symmetric_relay())
    with pytest.raises(ValueError, match="3 or more, not 2"):
        run_relay_tests(relay_tests(1.0, 0.0, 10.0, 2.0), 2)


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


@pytest.mark.parametrize("switches", [4, 20, 60])
def test_plants_and_relays_at_random_are_as_in_the_general_run(switches):
    """The same as one by one; the poles of the single plants are taken from rounded coefficients."""
    tests = random_tests(np.random.default_rng(100 + switches), 150)
    batch = run_relay_tests(tests, switches)
    assert np.count_nonzero(np.isfinite(batch.period_s)) > 130
    for i, (plant, relay) in enumerate(plants_and_relays(tests)):
        run = run_relay(plant, relay, 1e9, max_switches=switches)
        assert bool(batch.starts_high[i]) == (run.levels[0] == relay.high)
        assert np.count_nonzero(np.isfinite(batch.switches_s[i])) == run.times_s.size - 1
        if np.isfinite(batch.period_s[i]):
            lowest, highest = run.extremes(run.times_s[-3], run.times_s[-1])
            truth = run.times_s[-1] - run.times_s[-3], (highest - lowest) / 2.0
            assert (batch.period_s[i], batch.peak[i]) == pytest.approx(truth, rel=1e-11)


@pytest.mark.parametrize("switches", [19, 20])
def test_times_at_each_level_belong_to_it(switches):
    """Whichever level the last half period has."""
    for relay in (Relay(-1.0, 2.0, hysteresis=0.05), Relay(-1.0, 2.0, reference=-0.2, hysteresis=0.05)):
        plant = SopdtOverdamped(1.0, 10.0, 1.0, 2.0)
        batch, cycle = run_relay_tests(relay_test(plant, relay), switches), find_limit_cycle(plant, relay)
        assert (batch.high_s[0], batch.low_s[0]) == pytest.approx((cycle.high_s, cycle.low_s), rel=1e-9)


def test_a_batch_of_settled_cycles_with_their_fundamentals():
    """Plants of all three kinds in turn, against cycles solved for one by one."""
    rng = np.random.default_rng(4)
    size = 3_000
    K, T, D, part = rng.uniform(0.1, 5.0, size), rng.uniform(1.0, 20.0, size), rng.uniform(1.0, 5.0, size), 0.3
    kind = np.arange(size) % 3
    m = np.choose(kind, (0.0 * T, part * T**2, T**2))
    n = np.choose(kind, (T, (1.0 + part) * T, 1.6 * T))
    batch = run_relay_tests(relay_tests(K, m, n, D, -1.0, 1.5, hysteresis=0.05 * K), switches=200)
    for i in range(0, size, 103):
        plant = {
            0: lambda i=i: Fopdt(K[i], T[i], D[i]),
            1: lambda i=i: SopdtOverdamped(K[i], T[i], part * T[i], D[i]),
            2: lambda i=i: SopdtUnderdamped(K[i], m[i], n[i], D[i]),
        }[kind[i]]()
        assert coefficients(plant) == pytest.approx((m[i], n[i]))
        cycle = find_limit_cycle(plant, Relay(-1.0, 1.5, hysteresis=0.05 * K[i]))
        found = (batch.high_s[i], batch.low_s[i], batch.peak[i], batch.fundamental[i])
        assert found == pytest.approx((cycle.high_s, cycle.low_s, cycle.peak, cycle.fundamental), rel=1e-10)


def test_a_batch_knows_which_plants_turn_once():
    """Half a turn of the free motion is 3.2 s: with a dead time over that the PV must have turned before an arrival."""
    batch = run_relay_tests(relay_tests(1.0, [0.0, 1.0, 1.0, 1.0], [1.0, 3.0, 0.4, 0.4], [9.0, 9.0, 0.3, 3.3]))
    assert batch.turns_once.tolist() == [True, True, True, False]


@settings(max_examples=30)
@given(st.data(), st.floats(1e-3, 1e4))
def test_another_unit_of_time_scales_the_times(data, factor):
    plant = data.draw(plants())
    m, n = coefficients(plant)
    row = plant.K, m, n, plant.D
    scaled = plant.K, m * factor**2, n * factor, plant.D * factor
    batch = run_relay_tests(relay_tests(*np.array([row, scaled]).T, hysteresis=0.1 * abs(plant.K)))
    assert batch.switches_s[1] == pytest.approx(factor * batch.switches_s[0], rel=1e-9)


@pytest.fixture(scope="module")
def c_program(tmp_path_factory):
    """The benchmark's C program of the same loop."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc) is installed")
    return simulation, simulation.CProgram(compiler, str(tmp_path_factory.mktemp("c")))


@pytest.mark.parametrize("structure", ["fopdt", "overdamped", "underdamped"])
def test_thousands_of_random_plants_are_as_in_a_c_program(c_program, structure):
    module, program = c_program
    tests = module.random_plants(structure)
    for ours, theirs in zip(module.by_kernel(tests), program.by_events(tests), strict=True):
        assert np.isfinite(theirs).all()
        assert ours == pytest.approx(theirs, rel=1e-12)


def run_program(program, path, **environment):
    """Return what a program prints in an interpreter of its own."""
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"import sys; sys.path[:0] = {path!r}\n{program}"],
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
        env={**{name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}, **environment},
    )
    return found.stdout


def test_plants_and_devices_never_import_numba():
    program = """
import autotuner_sim.plc_command, autotuner_drivers.simulated
from autotuner_sim import Fopdt, find_limit_cycle, symmetric_relay
assert find_limit_cycle(Fopdt(1.0, 10.0, 2.0), symmetric_relay()).period_s > 0.0
print("numba" in sys.modules)
"""
    assert run_program(program, [entry for entry in sys.path if entry]) == "False\n"


def test_without_numba_the_kernel_is_slower_and_the_same():
    """Plain Python, of every kind, exact and sampled, warnings being errors."""
    program = """
sys.modules["numba"] = None
import json
import numpy as np
from autotuner_sim.relay import kernel
from autotuner_sim.relay.batch import relay_tests, run_relay_tests, run_sampled_relay_tests
assert kernel.NUMBA is None
tests = relay_tests(1.0, [0.0, 20.0, 100.0, 1.0], [10.0, 12.0, 4.0, 2.0], [2.0, 2.0, 30.0, 0.0], hysteresis=0.05)
exact = run_relay_tests(tests, 8)
sampled = run_sampled_relay_tests(tests, np.random.default_rng(1).normal(size=4000), 0.05, scale=0.01, switches=4)
print(json.dumps([row.tolist() for batch in (exact, sampled) for row in (batch.switches_s, batch.peak)]))
"""
    found = json.loads(run_program(program, [entry for entry in sys.path if entry]))
    tests = relay_tests(1.0, [0.0, 20.0, 100.0, 1.0], [10.0, 12.0, 4.0, 2.0], [2.0, 2.0, 30.0, 0.0], hysteresis=0.05)
    noise = np.random.default_rng(1).normal(size=4000)
    batches = run_relay_tests(tests, 8), run_sampled_relay_tests(tests, noise, 0.05, scale=0.01, switches=4)
    expected = [row for batch in batches for row in (batch.switches_s, batch.peak)]
    for ours, theirs in zip(found, expected, strict=True):
        assert np.allclose(ours, theirs, rtol=1e-13, atol=0.0, equal_nan=True)


@pytest.mark.long  # a kernel is compiled once more
def test_where_no_cache_can_be_written_each_process_compiles(tmp_path):
    """Neither the package's folder nor the user's cache takes a file, as in a read-only container."""
    package = shutil.copytree(
        Path(autotuner_sim.__file__).parent, tmp_path / "autotuner_sim", ignore=shutil.ignore_patterns("__pycache__")
    )
    for folder in (package / "relay" / "__pycache__", tmp_path / "cache"):
        folder.write_text("a file where a folder would have to be")
    program = """
from autotuner_sim.relay.batch import relay_tests, run_relay_tests
print(run_relay_tests(relay_tests(1.0, 0.0, 10.0, 2.0)).period_s[0])
"""
    found = run_program(program, [str(tmp_path)], XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert float(found) == pytest.approx(20.0 * math.log(2.0 * math.exp(0.2) - 1.0), rel=1e-12)
    assert not list(package.rglob("*.nbc"))
