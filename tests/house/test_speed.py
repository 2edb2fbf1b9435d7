"""Ratios of processor time within one process, with floors at about a third of what is meant (docs/speed.md)."""

import pytest

from benchmarks.latency import filters, start

pytestmark = [pytest.mark.realtime, pytest.mark.alone]


def test_a_sample_of_the_detector_is_cheaper_than_a_call_of_sosfilt():
    rounds = [(filters.by_scipy(), filters.by_the_detector()[0] + filters.by_the_filter()) for _ in range(5)]
    theirs, ours = (min(one) for one in zip(*rounds, strict=True))
    assert theirs > 25.0 * ours


def test_help_costs_little_beside_what_the_service_stands_on():
    theirs = start.spent_s("-c", start.EAGER, env=None)[0]
    ours = start.spent_s("-m", "autotuner", "--help", env=None)[0]
    assert ours < 0.45 * theirs
