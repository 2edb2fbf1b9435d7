"""One wrong key at a time: where it stands in the file, what is wrong with it, and what to do, in words of the file."""

import copy
import math
import tomllib
from pathlib import Path

import pytest

from autotuner.configuration import parse_configuration
from autotuner.errors import ConfigurationError

EXAMPLE = Path(__file__).parents[2] / "examples" / "plc.toml"
LOOP = ("loops", "TIC-101")


def told(place, value):
    """Return what is said of the example with one value changed."""
    values = copy.deepcopy(tomllib.loads(EXAMPLE.read_text(encoding="utf-8")))
    table = values
    for name in place[:-1]:
        table = table.setdefault(name, {})
    table[place[-1]] = value
    with pytest.raises(ConfigurationError) as caught:
        parse_configuration(values, "plc.toml")
    return caught.value


@pytest.mark.parametrize(
    ("place", "value", "message", "remedy"),
    [
        ("sample_time_s", "0.2", "is not a number", "without quotes"),
        ("sample_time_s", True, "is not a number", "a number"),
        ("sample_time_s", math.nan, "is not a finite number", "a finite number"),
        ("sample_time_s", 0, "must be 0.001 or more", "larger"),
        ("process_action", "up", "must be 'direct' or 'reverse'", "one of these"),
        ("pv_unit", 3, "is not a text", "in quotes"),
        ("own_process", "no", "is neither true nor false", "true or false"),
        ("limits", 5, "is not a table", "as a table"),
        ("limits.output", "0..100", "is not a list", "[ ... ]"),
        ("limits.output", [0, 50, 100], "has 3 values, not 2", "surplus"),
        ("limits.ouput", [0, 100], "is not a known key", "spelling"),
        ("relay.check", "yes", "is neither true nor false", "true or false"),
        ("relay.side", "warm", "must be 'heat' or 'cool'", "one of these"),
        ("relay.min_periods", 2.5, "is not a whole number", "whole number"),
        ("relay.amplitude", 51.0, "swings 102", "Give 50 at most"),
        ("relay.ratio", 6.0, "must lie between 1 and 5", "inside"),
        ("relay.max_periods", 1, "must be 2 or more", "larger"),
        ("relay.online.Kp", -1.0, "must be positive", "Turn the sign"),
        ("safety.frozen_samples", 2, "must be 3 or more", "larger"),
        ("gains.form", "", "is empty", "leave the key out"),
    ],
)
def test_a_wrong_key_of_a_loop_is_told_by_its_place(place, value, message, remedy):
    error = told((*LOOP, *place.split(".")), value)
    assert error.field == f"plc.toml: loops.TIC-101.{place}"
    assert message in error.message
    assert remedy in error.remedy
    assert repr(error.value) == repr(value)


@pytest.mark.parametrize(("key", "value"), [("host", ""), ("port", "8321"), ("port", 70000), ("real_time", True)])
def test_a_wrong_key_of_the_service_is_told_by_its_place(key, value):
    assert told(("service", key), value).field == f"plc.toml: service.{key}"


def test_whole_numbers_stand_for_numbers():
    values = tomllib.loads(EXAMPLE.read_text(encoding="utf-8"))
    values["loops"]["TIC-101"]["sample_time_s"] = 1
    assert parse_configuration(values, "plc.toml").loops["TIC-101"].sample_time_s == 1.0
