"""Steady limit cycles against closed forms, the reference table, the event-driven run and numerical integrals."""

from __future__ import annotations

import csv
import dataclasses
import math

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim import (
    PLANTS,
    Fopdt,
    Integrating,
    InverseResponse,
    LagChain,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
    find_limit_cycle,
    run_relay,
    symmetric_relay,
)
from autotuner_sim.relay import limit_cycle

positive = st.floats(0.1, 10.0)
CYCLES = [
    (SopdtOverdamped(1.0, 10.0, 2.0, 4.0), symmetric_relay(hysteresis=0.05)),
    (SopdtOverdamped(-1.5, 7.5, 4.2, 5.0), Relay(-1.0, 2.0, hysteresis=0.02, direct=False)),
    (SopdtUnderdamped(1.0, 1.0, 0.4, 3.0), Relay(-1.0, 0.5, reference=0.1)),
    (SopdtUnderdamped(1.0, 1.0, 0.1, 20.0), symmetric_relay(hysteresis=0.1)),
    (Integrating(0.3, 3.0, 2.0), Relay(-1.0, 2.0, hysteresis=0.1)),
    (UnstableFopdt(1.0, 10.0, 2.0), Relay(-1.0, 1.2, hysteresis=0.05)),
    (InverseResponse(1.0, 5.0, 3.0, 1.0, 2.0), Relay(-1.0, 1.5)),
    (LagChain(1.0, (1.0, 1.0, 1.0, 1.0, 1.0), 0.0), Relay(-1.0, 1.5, hysteresis=0.02)),
]


def test_equals_the_reference_table(thesis_limit_cycles):
    lines = [line for line in thesis_limit_cycles.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert len(rows) == 9
    for row in rows:
        kind = PLANTS[row["process"]]
        plant = kind(**{field.name: float(row[field.name]) for field in dataclasses.fields(kind)})
        cycle = find_limit_cycle(plant, symmetric_relay())
        assert cycle.peak == pytest.approx(float(row["amplitude_peak"]), rel=1e-6)
        assert cycle.fundamental == pytest.approx(float(row["amplitude_fundamental"]), rel=1e-6)
        assert cycle.period_s == pytest.approx(float(row["period"]), rel=1e-6)


@pytest.mark.parametrize("ratio", [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0])
@pytest.mark.parametrize("T", [1e-3, 3.0, 7200.0])
def test_fopdt_under_an_ideal_relay_has_its_closed_form(ratio, T):
    K, h = 2.5, 1.5
    cycle = find_limit_cycle(Fopdt(K, T, ratio * T), symmetric_relay(h))
    assert cycle.peak == pytest.approx(K * h * -math.expm1(-ratio), rel=1e-11)
    assert cycle.period_s == pytest.approx(2.0 * T * math.log(2.0 * math.exp(ratio) - 1.0), rel=1e-11)


@given(
    K=positive,
    T=positive,
    D=positive,
    width=st.floats(0.0, 0.3),
    bias=st.floats(-0.5, 0.5),
    centre=st.floats(-0.1, 0.1),
)
def test_fopdt_with_hysteresis_and_bias_has_its_closed_form(K, T, D, width, bias, centre):
    """The PV runs on for `D` past each threshold to an extreme, and from there back to the other threshold."""
    relay = Relay(bias - 1.0, bias + 1.0, reference=centre * K, hysteresis=width * K)
    upper, lower = relay.reference + relay.hysteresis, relay.reference - relay.hysteresis
    decay = math.exp(-D / T)
    highest = K * relay.high - (K * relay.high - upper) * decay
    lowest = K * relay.low - (K * relay.low - lower) * decay
    cycle = find_limit_cycle(Fopdt(K, T, D), relay)
    assert cycle.extremes == pytest.approx((lowest, highest), rel=1e-9, abs=1e-9 * K)
    rise_s = T * math.log((K * relay.high - lowest) / (K * relay.high - upper))
    fall_s = T * math.log((highest - K * relay.low) / (lower - K * relay.low))
    assert (cycle.high_s, cycle.low_s) == pytest.approx((rise_s + D, fall_s + D), rel=1e-9)


@given(K=positive, D=positive, eps=st.floats(0.0, 5.0), bias=st.floats(-0.6, 0.6))
def test_an_integrator_has_its_closed_form(K, D, eps, bias):
    """Ramps of slope `K high` and `K low`; each overshoots its threshold by its slope times `D`."""
    high, low = bias + 1.0, bias - 1.0
    highest, lowest = eps + K * high * D, -eps + K * low * D
    cycle = find_limit_cycle(Integrating(K, 0.0, D), Relay(low, high, hysteresis=eps))
    assert cycle.extremes == pytest.approx((lowest, highest), rel=1e-9)
    assert cycle.high_s == pytest.approx((highest - lowest) / (K * high), rel=1e-9)
    assert cycle.low_s == pytest.approx((highest - lowest) / (-K * low), rel=1e-9)


@given(K=positive, T=positive, ratio=st.floats(0.01, 0.6))
def test_an_unstable_first_order_plant_has_its_closed_form(K, T, ratio):
    cycle = find_limit_cycle(UnstableFopdt(K, T, ratio * T), symmetric_relay())
    assert cycle.peak == pytest.approx(K * math.expm1(ratio), rel=1e-9)
    assert cycle.period_s == pytest.approx(2.0 * T * (ratio - math.log(2.0 - math.exp(ratio))), rel=1e-9)


def test_the_cycle_worked_by_hand():
    """K 2, T 10, D 10 ln 2: amplitude 2 (1 - 1/2), period 20 ln 3, input first harmonic 4/pi."""
    cycle = find_limit_cycle(Fopdt(2.0, 10.0, 10.0 * math.log(2.0)), symmetric_relay())
    assert cycle.peak == pytest.approx(1.0, rel=1e-13)
    assert cycle.period_s == pytest.approx(20.0 * math.log(3.0), rel=1e-13)
    w_T = math.pi / math.log(3.0)
    assert cycle.fundamental == pytest.approx(2.0 * 4.0 / math.pi / math.hypot(1.0, w_T), rel=1e-13)
    assert cycle.pv([0.0, cycle.high_s, cycle.period_s]).tolist() == pytest.approx([-1.0, 1.0, -1.0], rel=1e-13)


@pytest.mark.parametrize(("plant", "relay"), CYCLES, ids=str)
def test_is_where_a_long_run_ends(plant, relay):
    cycle = find_limit_cycle(plant, relay)
    run = run_relay(plant, relay, end_s=1e5, max_switches=400)
    rise = int(np.flatnonzero(run.levels[:-2] == relay.high)[-1])
    up, down, up_again = run.times_s[rise : rise + 3]
    assert down - up == pytest.approx(cycle.high_s, rel=1e-9)
    assert up_again - down == pytest.approx(cycle.low_s, rel=1e-9)
    inside = np.linspace(0.0, cycle.period_s, 101)
    start = up + plant.D - math.ceil(plant.D / cycle.period_s + 1.0) * cycle.period_s
    scale = cycle.peak
    assert np.allclose(run.pv(start + inside), cycle.pv(inside), rtol=0.0, atol=1e-7 * scale)


@pytest.mark.parametrize(("plant", "relay"), CYCLES, ids=str)
def test_amplitudes_are_those_of_the_wave(plant, relay):
    """Peak against a dense sampling, fundamental against its Fourier integral, by quadrature over both halves."""
    cycle = find_limit_cycle(plant, relay)
    pv = cycle.pv(np.append(np.linspace(0.0, cycle.period_s, 20001), cycle.high_s))
    assert cycle.peak == pytest.approx((pv.max() - pv.min()) / 2.0, rel=1e-6)
    w = 2.0 * math.pi / cycle.period_s

    def part(wave, low, high):
        return scipy.integrate.quad(lambda t: float(cycle.pv([t])[0]) * wave(w * t), low, high, limit=200)[0]

    halves = ((0.0, cycle.high_s), (cycle.high_s, cycle.period_s))
    cosine = sum(part(math.cos, low, high) for low, high in halves)
    sine = sum(part(math.sin, low, high) for low, high in halves)
    assert cycle.fundamental == pytest.approx(2.0 / cycle.period_s * math.hypot(cosine, sine), rel=1e-7)


@pytest.mark.parametrize(("plant", "relay"), CYCLES, ids=str)
def test_the_relay_law_holds_all_along(plant, relay):
    """While the output is high the PV has not passed the upper threshold, and the other way round."""
    cycle = find_limit_cycle(plant, relay)
    t = np.linspace(0.0, cycle.period_s, 4001)
    above = cycle.pv(t) - relay.reference if relay.direct else relay.reference - cycle.pv(t)
    is_high = cycle.output(t) == relay.high
    slack = 1e-9 * cycle.peak
    assert np.all(above[is_high] <= relay.hysteresis + slack)
    assert np.all(above[~is_high] >= -relay.hysteresis - slack)
    assert is_high.mean() == pytest.approx(cycle.high_s / cycle.period_s, abs=1e-3)


@settings(max_examples=40)
@given(
    damping=st.floats(0.2, 3.0), speed=positive, D=positive, gain=st.floats(1e-3, 1e3), time=st.floats(1e-3, 1e4),
    bias=st.floats(-0.4, 0.4),
)  # fmt: skip
def test_units_of_time_and_pv_only_scale_it(damping, speed, D, gain, time, bias):
    relay = Relay(bias - 1.0, bias + 1.0)

    def second_order(K, w, D):
        m, n = 1.0 / w**2, 2.0 * damping / w
        if damping < 1.0:
            return SopdtUnderdamped(K, m, n, D)
        root = math.sqrt(max(damping**2 - 1.0, 0.0))
        return SopdtOverdamped(K, (damping + root) / w, (damping - root) / w, D)

    base = find_limit_cycle(second_order(1.0, speed, D), relay)
    other = find_limit_cycle(second_order(gain, speed / time, D * time), relay)
    assert other.high_s == pytest.approx(time * base.high_s, rel=1e-8)
    assert other.low_s == pytest.approx(time * base.low_s, rel=1e-8)
    assert other.peak == pytest.approx(gain * base.peak, rel=1e-8)


@pytest.mark.parametrize(
    ("plant", "relay"),
    [
        (Fopdt(1.0, 5.0, 1.0), Relay(0.5, 1.0)),
        (Fopdt(1.0, 5.0, 1.0), symmetric_relay(hysteresis=2.0)),
        (UnstableFopdt(1.0, 1.0, 1.0), symmetric_relay()),
    ],
    ids=["levels on one side", "dead zone out of reach", "runs away"],
)
def test_says_when_there_is_none(plant, relay):
    with pytest.raises(ValueError, match="does not oscillate"):
        find_limit_cycle(plant, relay)


def test_says_when_a_run_was_too_short_to_settle(monkeypatch):
    """A hardly damped plant rings on for longer than the run: no word of there being no cycle."""
    monkeypatch.setattr(limit_cycle, "_ATTEMPTS", (6,))
    with pytest.raises(ValueError, match=r"not settled .* within 6 switches"):
        find_limit_cycle(SopdtUnderdamped(1.0, 1.0, 1e-4, 7.3), symmetric_relay())
