"""Every size that a catalogued effect reports has a unit, and the reports state it in the units of the loop."""

import pytest

from autotuner.core.diagnosis.findings.effect_units import UNITS, unit_of
from autotuner.core.diagnosis.findings.result import FoundEffect
from autotuner.reports.numbers import Units

RATIOS = {
    "ratio",
    "rise_over_fall",
    "share",
    "strength",
    "followed",
    "relative_change",
    "largest_relative_change",
    "slope_at_rest",
}


@pytest.mark.parametrize(
    ("place", "size", "unit"),
    [
        ("actuator", "width", "output"),
        ("actuator", "step", "output"),
        ("sensor", "step", "PV"),
        ("sensor", "size", "PV"),
        ("disturbance", "size", "output"),
        ("disturbance", "at_s", "s"),
        ("actuator", "rate_per_s", "output/s"),
        ("process", "cubic_per_pv2", "1/PV²"),
        ("actuator", "ratio", ""),
    ],
)
def test_a_size_has_its_unit(place, size, unit):
    assert unit_of(place, size) == unit


def test_ratios_have_none():
    assert not any(unit_of("process", name) for name in RATIOS)
    assert RATIOS.isdisjoint(UNITS)


def test_units_are_those_of_the_loop():
    hold = FoundEffect("rate_limit", "actuator", {"rate_per_s": 2.0, "at_s": 1.0}, {}, 0.9)
    units = Units.of("degC", "%")
    assert [units.named(unit) for unit in hold.units.values()] == ["%/s", "s"]
    assert units.named("output/PV") == "%/degC"
    assert Units.of("", "").named("1/PV²") == "1/PV²"
