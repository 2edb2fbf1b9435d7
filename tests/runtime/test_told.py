"""What a running tuning tells when it is asked often: lateness counted seldom, and exact in the end."""

from types import SimpleNamespace

import pytest

from autotuner.core.recording import Sample
from autotuner.core.verdict import aborted
from autotuner.runtime.tuning import Tuning


def late(count):
    """Return samples that are 1, 2, .. ms late."""
    return [Sample(float(k), 0.0, 0.0, 0.0, 1e-3 * (k + 1)) for k in range(count)]


def test_lateness_is_counted_again_with_every_hundredth_sample_and_at_the_end():
    tuning = Tuning("id", "loop", request=None)
    assert tuning._lateness() is None
    tuning.controller = SimpleNamespace(samples=late(1000))
    told = tuning._lateness()
    assert (told["p50_s"], told["max_s"]) == pytest.approx((0.5005, 1.0))
    tuning.controller.samples = late(1009)
    assert tuning._lateness() is told
    tuning.controller.samples = late(1010)
    assert tuning._lateness()["max_s"] == pytest.approx(1.01)
    tuning.controller.samples = late(1011)
    tuning.verdict = aborted("requested", "", "")
    assert tuning._lateness()["max_s"] == pytest.approx(1.011)
