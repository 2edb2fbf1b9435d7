"""What the device holds: rounding is learnt, a foreign output is a verdict."""

import math

from autotuner.core.safety.read_back import STRIKES, ReadBack


def test_rounding_by_the_device_goes_into_the_record():
    back = ReadBack(0.5)
    assert back.held(28.333, 28.3) == 28.3
    assert back.check(1.0, 28.333, 28.3) is None


def test_a_device_that_does_not_tell_is_believed():
    back = ReadBack(0.5)
    assert back.held(28.333, None) == 28.333
    assert back.held(28.333, math.nan) == 28.333


def test_a_foreign_output_ends_the_tuning_only_when_it_stays():
    back = ReadBack(0.5)
    for _ in range(STRIKES - 1):
        assert back.held(30.0, 0.0) == 30.0
        assert back.check(1.0, 30.0, 0.0) is None
    assert back.held(30.0, 30.0) == 30.0
    for _ in range(STRIKES):
        back.held(30.0, 0.0)
    verdict = back.check(7.25, 30.0, 0.0)
    assert verdict.code == "output_overridden"
    assert "7.250" in verdict.message


def read_all(back, commands, readings):
    return [back.held(u, seen) for u, seen in zip(commands, readings, strict=True)]


def test_a_damaged_reading_is_told_and_not_believed():
    back = ReadBack(0.5)
    assert read_all(back, [30.0] * 4, [30.0, 0.0, 30.0, 30.0]) == [30.0] * 4
    assert back.damaged == ["the output was read as 0 where 30 was commanded"]


def test_an_output_that_follows_a_scan_late_is_not_damaged():
    back = ReadBack(0.5)
    read_all(back, [30.0, 50.0, 50.0, 50.0], [30.0, 30.0, 42.0, 50.0])
    assert back.damaged == []
