"""Closed forms against the event-driven simulator, which solves the cycle in another way."""

import csv
import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from autotuner.errors import InputError
from autotuner_models.first_order_cycle import fopdt_by_fundamental, fopdt_of_cycle, fopdt_symmetric
from autotuner_sim.plants import Fopdt as Plant
from autotuner_sim.relay import Relay
from autotuner_sim.relay.limit_cycle import find_limit_cycle


def test_symmetric_by_hand():
    # D/T = ln 2: the amplitude is half of K h and the period 2 T ln 3.
    model = fopdt_symmetric(3.0, 2.0, 3.0, 2.0 * 5.0 * math.log(3.0))
    assert pytest.approx((3.0, 5.0, 5.0 * math.log(2.0)), rel=1e-14) == (model.K, model.T, model.D)


@pytest.mark.parametrize("d", [0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0])
def test_symmetric_has_no_bias_on_the_simulators_cycles(cycle_of, d):
    cycle = cycle_of(Plant(1.7, 10.0, 10.0 * d), Relay(-2.0, 2.0))
    model = fopdt_symmetric(1.7, 2.0, cycle.A, cycle.Pu)
    # The amplitude nears K h as e^{-d}: from its last digit, d can be read to e^d times the rounding error only.
    allowed = max(1e-9, 1e-14 * math.exp(d))
    assert pytest.approx((10.0, 10.0 * d), rel=allowed) == (model.T, model.D)


def test_by_fundamental_by_hand():
    # D/T = ln 2: the period is 2 T ln 3, so w T = pi/ln 3 and A1 = 4/pi K h/sqrt(1 + (pi/ln 3)^2).
    A1 = 4.0 / math.pi * 6.0 / math.hypot(1.0, math.pi / math.log(3.0))
    model = fopdt_by_fundamental(3.0, 2.0, A1, 2.0 * 5.0 * math.log(3.0))
    assert pytest.approx((3.0, 5.0, 5.0 * math.log(2.0)), rel=1e-14) == (model.K, model.T, model.D)


@pytest.mark.parametrize("d", [0.01, 0.1, 1.0, 5.0, 10.0, 30.0, 40.0, 50.0])
@pytest.mark.parametrize("K", [1.7, -1.7])
def test_by_fundamental_resolves_any_dead_time(d, K):
    # The simulator's own fundamental: |G(jw)| times that of the relay's wave, with the period it solved for.
    cycle = find_limit_cycle(Plant(K, 10.0, 10.0 * d), Relay(-2.0, 2.0, direct=K > 0.0))
    model = fopdt_by_fundamental(K, 2.0, cycle.fundamental, cycle.period_s)
    assert pytest.approx((K, 10.0, 10.0 * d), rel=1e-9) == (model.K, model.T, model.D)


@pytest.mark.parametrize("K", [0.3, -0.3, 0.0])
def test_a_fundamental_that_no_first_order_process_reaches_is_refused(K):
    with pytest.raises(InputError, match="first-order"):
        fopdt_by_fundamental(K, 1.0, 0.5, 10.0)


def test_symmetric_on_the_cycles_of_the_thesis(shared):
    lines = (shared / "thesis" / "limit_cycles.csv").read_text(encoding="utf-8").splitlines()
    rows = [row for row in csv.DictReader(x for x in lines if not x.startswith("#")) if row["process"] == "fopdt"]
    assert rows
    for row in rows:
        model = fopdt_symmetric(float(row["K"]), 1.0, float(row["amplitude_peak"]), float(row["period"]))
        # The file gives seven decimals.
        assert pytest.approx((float(row["T"]), float(row["D"])), rel=2e-6) == (model.T, model.D)


@given(
    K=st.one_of(st.floats(0.1, 15.0), st.floats(-15.0, -0.1)),
    T=st.floats(0.1, 100.0),
    d=st.floats(0.05, 5.0),
    bias=st.floats(-0.5, 0.5),
    share=st.floats(0.0, 0.5),
)
def test_biased_relay_with_hysteresis(cycle_of, K, T, d, bias, share):
    assume(share * (1.0 + abs(bias)) < 0.9)
    relay = Relay(bias - 1.0, bias + 1.0, hysteresis=share * abs(K) * (1.0 - abs(bias)), direct=K > 0.0)
    cycle = cycle_of(Plant(K, T, d * T), relay)
    model = fopdt_of_cycle(K, cycle)
    assert pytest.approx((K, T, d * T), rel=1e-6) == (model.K, model.T, model.D)


def test_the_threshold_of_the_relay_need_not_be_known(cycle_of):
    # Any PV on the way up with its time to the top will do: here the relay acts a tenth of a second late.
    plant, relay = Plant(2.0, 10.0, 1.5), Relay(-1.0, 2.0, hysteresis=0.05)
    late = Plant(2.0, 10.0, 1.6)
    cycle = cycle_of(late, relay)
    assert pytest.approx(late.D, rel=1e-9) == fopdt_of_cycle(2.0, cycle).D
    assert pytest.approx(plant.T, rel=1e-9) == fopdt_of_cycle(2.0, cycle).T


@pytest.mark.parametrize("K", [0.4, 0.5, -0.5, 0.0])
def test_an_amplitude_that_no_first_order_process_reaches_is_refused(K):
    with pytest.raises(InputError, match="first-order"):
        fopdt_symmetric(K, 1.0, 0.5, 10.0)


def test_no_positive_values_are_refused_by_name():
    with pytest.raises(InputError) as error:
        fopdt_symmetric(1.0, 1.0, 0.5, -1.0)
    assert error.value.field == "Pu"
