"""What comes at one time after the moves of the output is an answer of the process, not a spike."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner.core.estimation.noise.outliers import answers
from autotuner.core.identification.procedure import identify
from autotuner.core.notes import warnings_among
from autotuner.core.recording import Recording
from autotuner_sim import InverseResponse, Noise, SteppedPlant

MOVES_S = np.arange(10.0, 200.0, 20.0)
T = np.arange(0.0, 210.0)


def spikes_at(times_s):
    return np.isin(T, times_s)


def test_peaks_at_one_lag_are_answers():
    peaks = spikes_at(MOVES_S + 6.0)
    assert np.array_equal(answers(peaks, T, MOVES_S, 1.0), peaks)


def test_a_lag_may_differ_by_a_sample():
    peaks = spikes_at(MOVES_S + np.tile([6.0, 7.0], 5))
    assert np.array_equal(answers(peaks, T, MOVES_S, 1.0), peaks)


def test_peaks_at_all_kinds_of_lags_are_spikes():
    peaks = spikes_at(MOVES_S + 1.9 * np.arange(MOVES_S.size) // 1.0)
    assert peaks.sum() == MOVES_S.size
    assert not answers(peaks, T, MOVES_S, 1.0).any()


def test_one_burst_is_no_answer():
    assert not answers(spikes_at([16.0, 17.0, 18.0, 19.0]), T, MOVES_S, 1.0).any()


def test_an_output_that_moves_all_the_time_tells_no_lag():
    assert not answers(spikes_at(MOVES_S + 6.0), T, T[::2], 1.0).any()


def relay_like(plant, interval_s, sigma):
    """Return a record in which the output goes up and down by itself, with unequal holds."""
    stepped = SteppedPlant(plant, sensors=[Noise(sigma, 1)])
    samples = []
    for k in range(300):
        t = k * interval_s
        stepped.advance(t)
        samples.append((t, stepped.measure()))
        stepped.output = 0.0 if t < 3.0 else (1.0 if (t - 3.0) % 11.0 < 4.7 else -1.0)
        samples[-1] += (stepped.output,)
    t, pv, output = np.array(samples).T
    return Recording(t, output, pv)


@pytest.mark.parametrize("Z", [0.5, 0.8])
def test_the_dip_of_an_inverse_response_is_not_left_out(Z):
    """It lasts two samples, far behind a dead time: without it the record shows one lag and a longer dead time."""
    found = identify(relay_like(InverseResponse(1.0, 0.84, 0.16, Z, 3.7), 0.4, 0.05))
    assert found.structure == "inverse_response"
    assert abs(found.model.Z - Z) < 0.3
    assert not any("outliers" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    ("T1", "T2", "Z", "D", "interval_s"),
    [(0.84, 0.16, 0.5, 3.7, 0.4), (0.6, 0.17, 0.74, 0.16, 0.4), (2.91, 0.73, 0.72, 0.86, 0.2)],
)
def test_an_inverse_response_is_found_without_noise(T1, T2, Z, D, interval_s):
    """A later start with a zero on the other side, or in the next sample, comes close and is another process."""
    found = identify(relay_like(InverseResponse(1.0, T1, T2, Z, D), interval_s, 1e-4))
    assert found.structure == "inverse_response"
    assert found.model.parameters() == pytest.approx({"K": 1.0, "T1": T1, "T2": T2, "Z": Z, "D": D}, rel=0.02)


@pytest.mark.parametrize(("share", "asks_for_action"), [(0.02, False), (0.5, True)])
def test_outliers_are_warned_of_where_they_matter(share, asks_for_action):
    """A twentieth of the samples is off, by a share of the PV's standard deviation."""
    record = relay_like(InverseResponse(1.0, 0.84, 0.16, 0.5, 3.7), 0.4, 0.001)
    off = np.zeros(len(record))
    off[10::20] = share * float(np.std(record.pv)) * np.random.default_rng(7).choice([-1.0, 1.0], off[10::20].size)
    found = identify(replace(record, pv=record.pv + off))
    said = [message for message in found.warnings if "left out as outliers" in message]
    assert len(said) == 1
    assert bool(warnings_among(said)) is asks_for_action
