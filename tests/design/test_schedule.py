import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import PidGains
from autotuner.core.design.schedule import gain_schedule, heat_cool
from autotuner.errors import InputError

THREE = [(80.0, PidGains(3.0, 30.0)), (20.0, PidGains(1.0, 10.0)), (40.0, PidGains(2.0, 20.0))]


def test_rows_are_ordered_and_borders_lie_between():
    schedule = gain_schedule(THREE)
    assert [row.value for row in schedule.rows] == [20.0, 40.0, 80.0]
    assert schedule.borders == (30.0, 60.0)
    assert schedule.hysteresis == pytest.approx(2.0)
    json.dumps(schedule.to_dict(), allow_nan=False)


def test_a_border_is_crossed_only_beyond_the_hysteresis():
    schedule = gain_schedule(THREE, hysteresis=3.0)
    assert schedule.select(31.0) == 1
    assert schedule.select(31.0, current=0) == 0
    assert schedule.select(33.5, current=0) == 1
    assert schedule.select(28.0, current=1) == 1
    assert schedule.select(26.5, current=1) == 0


def test_a_large_move_passes_several_rows():
    schedule = gain_schedule(THREE)
    assert schedule.select(100.0, current=0) == 2
    assert schedule.select(-100.0, current=2) == 0


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=50))
def test_noise_smaller_than_the_hysteresis_never_switches_back(values):
    schedule = gain_schedule(THREE, hysteresis=5.0)
    row = None
    for value in values:
        row = schedule.select(value, row)
        for jitter in (-4.9, 4.9):
            assert abs(schedule.select(value + jitter, row) - row) <= 1
        assert schedule.select(value, row) == row


def test_heating_and_cooling_change_at_zero_output():
    schedule = heat_cool(PidGains(3.0, 30.0), PidGains(1.0, 10.0), hysteresis=1.0)
    assert schedule.borders == (0.0,)
    heating = schedule.select(50.0)
    assert schedule.rows[heating].gains.Kp == 3.0
    assert schedule.select(-0.5, heating) == heating
    assert schedule.rows[schedule.select(-1.5, heating)].gains.Kp == 1.0


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: gain_schedule(THREE[:1]), "schedule.rows"),
        (lambda: gain_schedule([*THREE, (20.0, PidGains(1.0))]), "schedule.rows"),
        (lambda: gain_schedule([*THREE, (math.nan, PidGains(1.0))]), "schedule.rows"),
        (lambda: gain_schedule([*THREE, (90.0, PidGains(-1.0))]), "schedule.rows"),
        (lambda: gain_schedule(THREE, hysteresis=11.0), "schedule.hysteresis"),
        (lambda: gain_schedule(THREE, hysteresis=-1.0), "schedule.hysteresis"),
        (lambda: heat_cool(PidGains(1.0), PidGains(1.0), 0.0), "schedule.hysteresis"),
    ],
)
def test_what_is_no_schedule_is_refused_by_name(make, field):
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.field == field
