"""The prediction of the PV: lines by an independent fit, leads by closed forms, trips on exact responses."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.recording import Sample
from autotuner.core.safety.pv_prediction import PvWatch
from autotuner.core.safety.watches import SampleContext
from autotuner.core.signals.windowed_trend import CERTAIN, Latest


def trend_of(t, pv, before=()):
    """Return the line through samples that came after others."""
    latest = Latest()
    for moment, value in before:
        latest.take(moment, value)
    for moment, value in zip(t, pv, strict=True):
        latest.take(moment, value)
    return latest.trend(t[0], 3)


@settings(max_examples=50)
@given(
    pv=st.lists(st.floats(-100.0, 100.0), min_size=4, max_size=64),
    lead_s=st.floats(0.0, 50.0),
    before=st.integers(0, 200),
    seed=st.integers(0, 100),
)
def test_the_line_and_its_errors_are_those_of_least_squares(pv, lead_s, before, seed):
    """The judge: design matrix, and the covariance s^2 (X'X)^-1 of its textbook."""
    t = np.cumsum(np.random.default_rng(seed).uniform(0.1, 2.0, len(pv)))
    design = np.column_stack((np.ones(len(pv)), t))
    coefficients, *_ = np.linalg.lstsq(design, np.array(pv), rcond=None)
    left = np.array(pv) - design @ coefficients
    covariance = left @ left / (len(pv) - 2) * np.linalg.inv(design.T @ design)
    at = np.array([1.0, t[-1] + lead_s])
    expected = at @ coefficients - CERTAIN * math.sqrt(max(at @ covariance @ at, 0.0))
    others = [(k - before - 1.0, 100.0 * math.sin(k)) for k in range(before)]
    assert trend_of(t.tolist(), pv, others).ahead(lead_s, 1.0) == pytest.approx(expected, abs=1e-5, rel=1e-6)


def test_noise_has_no_direction():
    rng = np.random.default_rng(5)
    directions = [trend_of(list(range(20)), rng.standard_normal(20).tolist()).direction for _ in range(300)]
    assert sum(d != 0.0 for d in directions) <= 6


class Fopdt:
    """`T y' + y = K u(t - D)` from rest at 0, sampled every `dt`, exact for an output held between samples.

    The dead time is a whole number of samples.
    """

    def __init__(self, gain, lag_s, delay, dt):
        self.gain, self.keep, self.dt = gain, math.exp(-dt / lag_s), dt
        self.pipeline = [0.0] * delay
        self.y, self.k = 0.0, 0

    def step(self, output):
        """Hold the output for a sample; return the sample before it was answered."""
        sample = Sample(self.k * self.dt, self.y, output)
        self.pipeline.append(output)
        self.y = self.keep * self.y + (1.0 - self.keep) * self.gain * self.pipeline.pop(0)
        self.k += 1
        return sample


def drive(plant, watch, output, until, noise=lambda: 0.0):
    """Hold an output until the PV passes `until` or the watch trips; return its verdict."""
    upward = plant.y < until
    while (plant.y < until) == upward:
        sample = plant.step(output)
        seen = Sample(sample.t, sample.pv + noise(), output)
        verdict = watch.check(SampleContext(seen))
        if verdict is not None:
            return verdict
    return None


def rest(plant, watch, noise=lambda: 0.0):
    for _ in range(30):
        sample = plant.step(0.0)
        assert watch.check(SampleContext(Sample(sample.t, sample.pv + noise(), 0.0))) is None


@pytest.mark.parametrize(("lag_s", "delay"), [(20.0, 10), (50.0, 5), (10.0, 10)])
def test_the_lead_of_a_first_order_process(lag_s, delay):
    """overrun / slope = T (1 - e^{-D/T}); read off the verdict: PV + slope x lead."""
    watch, plant = PvWatch((-100.0, 100.0)), Fopdt(2.0, lag_s, delay, 0.25)
    rest(plant, watch)
    for target, output in [(3.0, 10.0), (-3.0, -10.0), (3.0, 10.0), (-3.0, -10.0)]:
        assert drive(plant, watch, output, target) is None
    reaction = watch._reaction
    exact = lag_s * (1.0 - math.exp(-delay * 0.25 / lag_s))
    assert reaction.lead_s(plant.k * 0.25, 1.0) == pytest.approx(exact, rel=0.35)


def overshoot_after(plant, limit, output):
    """How far the PV goes beyond the limit when the output is put to `output` now."""
    highest = plant.y
    for _ in range(200):
        plant.step(output)
        highest = max(highest, plant.y)
    return highest - limit


@pytest.mark.parametrize("sigma", [0.0, 0.02])
def test_a_push_towards_a_limit_is_withdrawn_in_time(sigma):
    """A lag of 100 s, a dead time of 10 s, the PV on its way from 0 to 50 with the limit at 20."""
    rng = np.random.default_rng(1)

    def noise():
        return sigma * rng.standard_normal()

    watch, plant = PvWatch((-10.0, 20.0)), Fopdt(5.0, 100.0, 10, 1.0)
    rest(plant, watch, noise)
    verdict = drive(plant, watch, 10.0, 20.0, noise)
    assert verdict.code == "pv_limit_predicted"
    blind = Fopdt(5.0, 100.0, 10, 1.0)
    while blind.y < 20.0:
        blind.step(10.0)
    assert overshoot_after(plant, 20.0, 0.0) < 0.5
    assert overshoot_after(blind, 20.0, 0.0) > 2.5


def test_a_process_that_settles_below_the_limit_is_not_stopped():
    """The first prediction stays below 1 - e^{-x} + x e^{-x + w/2T} of the way, largest near x = 2; w: 64 samples."""
    limit = 50.0 * (1.0 - math.exp(-2.0) + 2.0 * math.exp(-2.0 + 32.0 / 120.0))
    for delay in (20, 200, 1200):
        watch, plant = PvWatch((-100.0, limit)), Fopdt(5.0, 120.0, delay, 1.0)
        rest(plant, watch)
        assert drive(plant, watch, 10.0, 49.5) is None


def test_noise_near_the_limit_is_no_motion():
    """PV at rest with noise 1, six sigma under the limit."""
    rng = np.random.default_rng(2)
    watch = PvWatch((-100.0, 6.0))
    pv = np.clip(rng.standard_normal(4000), -4.0, 4.0)
    outputs = np.where(np.arange(4000) // 50 % 2, 10.0, -10.0)
    verdicts = [
        watch.check(SampleContext(Sample(float(k), float(y), float(u))))
        for k, (y, u) in enumerate(zip(pv, outputs, strict=True))
    ]
    assert not any(verdicts)


def test_the_swing_of_the_relay_is_not_held_against_it():
    """A limit just outside of the oscillation: after each turn the PV goes on, and that was to be expected."""
    plant, watch = Fopdt(2.0, 20.0, 10, 1.0), PvWatch((-8.6, 8.6))
    rest(plant, watch)
    for _ in range(8):
        for target, output in ((0.5, 10.0), (-0.5, -10.0)):
            assert drive(plant, watch, output, target) is None


def test_the_pv_at_rest_is_not_foreseen():
    """Before the output has moved a drift is none of its doing; only the limit itself counts."""
    watch = PvWatch((0.0, 100.0))
    verdicts = [watch.check(SampleContext(Sample(float(k), 2.0 * k, 40.0))) for k in range(52)]
    assert [k for k, v in enumerate(verdicts) if v] == [51]
    assert verdicts[51].code == "pv_limit"
