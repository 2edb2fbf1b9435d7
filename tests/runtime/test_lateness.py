"""Lateness for whoever asks often: counted seldom while a tuning runs, and exact at its end."""

import pytest

from autotuner.core.recording import Sample
from autotuner.runtime.lateness import Lateness


def late(count):
    """Return samples that are 1, 2, .. ms late."""
    return [Sample(float(k), 0.0, 0.0, 0.0, 1e-3 * (k + 1)) for k in range(count)]


def test_it_is_counted_again_with_every_hundredth_sample_and_at_the_end():
    lateness = Lateness()
    assert lateness.of([], ended=False) is None
    told = lateness.of(late(1000), ended=False)
    assert (told["p50_s"], told["max_s"]) == pytest.approx((0.5005, 1.0))
    assert lateness.of(late(1009), ended=False) is told
    assert lateness.of(late(1010), ended=False)["max_s"] == pytest.approx(1.01)
    assert lateness.of(late(1011), ended=True)["max_s"] == pytest.approx(1.011)
