"""Lateness for whoever asks often: counted seldom while a tuning runs, and exact at its end."""

import pytest

from autotuner.core.recording import Sample
from autotuner.core.recording.lateness import Lateness


def late(count):
    """Return samples that are 1, 2, .. ms late."""
    return [Sample(float(k), 0.0, 0.0, 0.0, 1e-3 * (k + 1)) for k in range(count)]


def test_percentiles_are_counted_again_with_every_tenth_sample_and_at_the_end():
    lateness = Lateness()
    assert lateness.of([], ended=False) is None
    assert lateness.of(late(1000), ended=False) == pytest.approx({"p50_s": 0.5005, "p99_s": 0.99001, "max_s": 1.0})
    assert lateness.of(late(1099), ended=False) == pytest.approx({"p50_s": 0.5005, "p99_s": 0.99001, "max_s": 1.099})
    assert lateness.of(late(1100), ended=False)["p50_s"] == pytest.approx(0.5505)
    assert lateness.of(late(1110), ended=False)["p50_s"] == pytest.approx(0.5505)
    assert lateness.of(late(1110), ended=True)["p50_s"] == pytest.approx(0.5555)


def test_the_largest_is_of_all_samples():
    lateness, samples = Lateness(), late(100)
    lateness.of(samples, ended=False)
    samples.insert(50, samples.pop())  # one that was told before stays the largest
    samples.append(Sample(100.0, 0.0, 0.0, 0.0, 0.001))
    assert lateness.of(samples, ended=False)["max_s"] == pytest.approx(0.1)
