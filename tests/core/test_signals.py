"""Band-pass, detector and quiet measurement, judged by sines, exact limit cycles and known noise."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.signals.apex import apex
from autotuner.core.signals.bandpass import QUALITY, BandPass
from autotuner.core.signals.detector import Detector
from autotuner.core.signals.quiet import largest_noise, measure_quiet
from autotuner_sim import Fopdt, SopdtOverdamped, SopdtUnderdamped, find_limit_cycle, symmetric_relay


def test_bandpass_equals_scipy_sections():
    """The same two sections as scipy designs them from the analogue prototype."""
    period, dt = 7.0, 0.11
    w0 = 2.0 * np.pi / period
    warped = np.tan(w0 * dt / 2.0) * 2.0 / dt
    b, a = scipy.signal.bilinear([warped / QUALITY, 0.0], [1.0, warped / QUALITY, warped**2], fs=1.0 / dt)
    x = np.random.default_rng(0).standard_normal(400)
    expected = scipy.signal.lfilter(b, a, scipy.signal.lfilter(b, a, x))
    band = BandPass(period)
    assert [band.step(v, dt) for v in x] == pytest.approx(expected.tolist(), abs=1e-12)


@settings(max_examples=40)
@given(ratio=st.floats(0.3, 3.0), samples=st.integers(20, 300))
def test_bandpass_gain_and_phase_are_what_it_says(ratio, samples):
    """A long sine comes out with the stated gain and phase; the judge is a sine fit by least squares."""
    period, dt = ratio, 1.0 / samples
    band = BandPass(1.0)
    t = np.arange(int(30 * max(period, 1.0) / dt)) * dt
    out = np.array([band.step(float(np.sin(2.0 * np.pi * v / period)), dt) for v in t])
    last = t > t[-1] - 4.0 * period
    basis = np.column_stack((np.sin(2.0 * np.pi * t / period), np.cos(2.0 * np.pi * t / period)))[last]
    c = np.linalg.lstsq(basis, out[last], rcond=None)[0]
    assert complex(c[0], c[1]) == pytest.approx(band.response_at(period, dt), abs=1e-4)


def test_bandpass_is_transparent_at_its_centre():
    assert BandPass(5.0).response_at(5.0, 0.1) == pytest.approx(1.0)


@pytest.mark.parametrize("corner", [True, False])
def test_apex_under_noise(corner):
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 1.0, 400)
    wave = 1.0 - 4.0 * np.abs(t - 0.5) if corner else np.sin(np.pi * t)
    heights = [apex(t, wave + 0.05 * rng.standard_normal(t.size), 1.0) for _ in range(60)]
    assert np.mean(heights) == pytest.approx(1.0, abs=0.02)
    assert np.std(heights) < 0.05
    assert apex(t, wave, 1.0) == pytest.approx(1.0, abs=0.003)


def relay_cycle(K, T, D, dt, periods, noise=0.0, seed=0):
    """Samples of the exact symmetric FOPDT limit cycle: closed form, no simulation."""
    half = T * np.log(2.0 * np.exp(D / T) - 1.0)
    peak = K * (1.0 - np.exp(-D / T))
    t = np.arange(0.0, 2.0 * half * periods, dt)
    position = np.floor(t / half).astype(int)
    phase = t - position * half
    rising = np.where(
        phase < D, -K + K * np.exp(-phase / T), K - (K + peak) * np.exp(-(phase - D) / T)
    )  # after a switch to high at pv = 0: falls to -peak over D, then rises to 0
    pv = np.where(position % 2 == 0, rising, -rising)
    return t, pv + noise * np.random.default_rng(seed).standard_normal(t.size), position % 2 == 0


@pytest.mark.parametrize(("share", "ratio"), [(0.05, 0.2), (0.5, 1.0), (2.0, 3.0)])
def test_detector_measures_the_exact_cycle(share, ratio):
    """Period, peak and fundamental of a closed-form cycle, to the sampling."""
    K, T = 2.0, 10.0 * ratio
    D = share * T
    half = T * np.log(2.0 * np.exp(D / T) - 1.0)
    t, pv, high = relay_cycle(K, T, D, half / 200.0, 6)
    detector = Detector()
    for moment, value, is_high in zip(t, pv, high, strict=True):
        detector.step(float(moment), float(value), is_high=bool(is_high))
    cycle = detector.cycles[-1]
    w = np.pi / half
    fundamental = K * 4.0 / np.pi / np.hypot(1.0, w * T)
    assert cycle.period_s == pytest.approx(2.0 * half, rel=0.006)
    assert cycle.peak == pytest.approx(K * (1.0 - np.exp(-share)), rel=0.012)
    assert cycle.fundamental == pytest.approx(fundamental, rel=0.006)
    assert cycle.duty == pytest.approx(0.5, abs=0.006)


def test_detector_at_20_db():
    """Noise a tenth of the signal's root mean square: amplitude within 3 %, averaged over the periods of one test."""
    K, T, D = 1.0, 10.0, 2.0
    half = T * np.log(2.0 * np.exp(D / T) - 1.0)
    clean = relay_cycle(K, T, D, half / 100.0, 8)[1]
    t, pv, high = relay_cycle(K, T, D, half / 100.0, 8, noise=0.1 * float(np.sqrt(np.mean(clean**2))))
    detector = Detector()
    for moment, value, is_high in zip(t, pv, high, strict=True):
        detector.step(float(moment), float(value), is_high=bool(is_high))
    assert np.mean([c.period_s for c in detector.cycles]) == pytest.approx(2.0 * half, rel=0.01)
    assert np.mean([c.peak for c in detector.cycles]) == pytest.approx(1.0 - np.exp(-0.2), rel=0.03)


def test_detector_ignores_a_drift():
    K, T, D = 1.0, 10.0, 2.0
    half = T * np.log(2.0 * np.exp(D / T) - 1.0)
    t, pv, high = relay_cycle(K, T, D, half / 200.0, 10)
    plain, drifting = Detector(), Detector()
    for moment, value, is_high in zip(t, pv, high, strict=True):
        plain.step(float(moment), float(value), is_high=bool(is_high))
        drifting.step(float(moment), float(value + 0.02 * moment), is_high=bool(is_high))
    assert drifting.cycles[-1].fundamental == pytest.approx(plain.cycles[-1].fundamental, rel=0.05)


def test_quiet_measures_what_was_put_in():
    rng = np.random.default_rng(1)
    t = np.arange(4000) * 0.5
    quiet = measure_quiet(t, 80.0 + 0.02 * t + 0.3 * rng.standard_normal(t.size))
    assert quiet.noise_sigma == pytest.approx(0.3, rel=0.06)
    assert quiet.drift_per_s == pytest.approx(0.02, abs=4.0 * quiet.drift_error_per_s)
    assert quiet.drifts
    assert quiet.sample_interval_s == 0.5


def test_quiet_is_robust_to_outliers_and_quantisation():
    rng = np.random.default_rng(1)
    pv = 20.0 + 0.05 * rng.standard_normal(2000)
    pv[::200] += 5.0
    assert measure_quiet(np.arange(2000.0), pv).noise_sigma == pytest.approx(0.05, rel=0.1)
    stepped = measure_quiet(np.arange(2000.0), np.round((20.0 + 0.05 * rng.standard_normal(2000)) / 0.1) * 0.1)
    assert stepped.noise_sigma == pytest.approx(0.05, rel=0.25)
    assert stepped.resolution == pytest.approx(0.1)
    assert not stepped.drifts


def test_a_constant_pv_is_quiet():
    quiet = measure_quiet(np.arange(30.0), np.full(30, 20.0))
    assert (quiet.noise_sigma, quiet.resolution, quiet.drifts) == (0.0, 0.0, False)


THESIS_PLANTS = [
    Fopdt(1.0, 10.0, 2.0),
    Fopdt(1.65, 20.0, 10.0),
    Fopdt(8.1, 9.4, 5.2),
    SopdtOverdamped(1.0, 10.0, 1.0, 2.0),
    SopdtOverdamped(1.0, 10.0, 2.0, 4.0),
    SopdtOverdamped(1.5, 7.5, 4.2, 5.0),
    SopdtUnderdamped(1.0, 9.0, 2.4, 1.0),
    SopdtUnderdamped(1.0, 1.0, 0.4, 3.0),
    SopdtUnderdamped(3.5, 9.4, 3.7, 7.0),
]


@pytest.mark.parametrize("plant", THESIS_PLANTS, ids=repr)
def test_detector_at_20_db_on_all_plants_of_the_thesis(plant):
    """The exact limit cycle, noise 20 dB under its mean square, eight periods: Pu within 1 %, A and A1 within 3 %."""
    cycle = find_limit_cycle(plant, symmetric_relay())
    t = np.arange(0.0, 8.0 * cycle.period_s, cycle.period_s / 200.0)
    clean, high = cycle.pv(t), cycle.output(t) > 0.0
    noise = 0.1 * float(np.sqrt(np.mean(clean**2))) * np.random.default_rng(11).standard_normal(t.size)
    detector = Detector()
    for moment, value, is_high in zip(t, clean + noise, high, strict=True):
        detector.step(float(moment), float(value), is_high=bool(is_high))
    measured = detector.cycles
    assert np.mean([c.period_s for c in measured]) == pytest.approx(cycle.period_s, rel=0.01)
    assert np.mean([c.peak for c in measured]) == pytest.approx(cycle.peak, rel=0.03)
    assert np.mean([c.fundamental for c in measured]) == pytest.approx(cycle.fundamental, rel=0.03)


def test_the_noise_that_is_feared_is_seldom_under_the_truth():
    """A one-sided 95 % limit of a standard deviation: of 400 draws of 60 samples about 20 lie under it."""
    rng = np.random.default_rng(2)
    found = np.array([largest_noise(80.0 + 0.05 * rng.standard_normal(60)) for _ in range(400)])
    assert 8 <= np.count_nonzero(found < 0.05) <= 36
    assert np.median(found) < 0.065


def test_one_wild_reading_is_no_noise():
    pv = 80.0 + 0.05 * np.random.default_rng(3).standard_normal(60)
    pv[17] = 500.0
    assert largest_noise(pv) < 0.075
    assert largest_noise(np.full(10, 3.0)) == 0.0
