"""The simulated device: scan, mode and its own PID, against hand-worked loops."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim.devices import plc_registers
from autotuner_sim.devices.loop_device import Gains, LoopDevice, Watchdog
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant


def device(**options) -> LoopDevice:
    sensors = options.pop("sensors", ())
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=sensors)
    return LoopDevice(plant, **options)


def test_manual_command_moves_the_plant_by_its_step_response():
    loop = device()
    loop.command(45.0)
    loop.advance(11.5)
    assert loop.measure() == pytest.approx(80.0 + 2.0 * 5.0 * (1.0 - math.exp(-1.0)))


def test_a_command_in_auto_is_lost():
    loop = device(auto=True, gains=Gains(0.0, 0.0, 0.0))
    loop.command(90.0)
    loop.advance(10.0)
    assert loop.output == 40.0


def test_a_command_is_held_within_the_limits():
    loop = device(limits=(10.0, 60.0))
    loop.command(1000.0)
    assert loop.output == 60.0
    loop.command(-1000.0)
    assert loop.output == 10.0


def test_going_to_auto_does_not_bump():
    loop = device(set_point=95.0, gains=Gains(3.0, 20.0, 0.0))
    loop.advance(5.0)
    loop.auto = True
    loop.advance(5.0 + loop._scan_s)
    assert loop.output == pytest.approx(40.0)


def test_proportional_control_leaves_its_hand_worked_offset():
    """`y = K Kp (3 - y)`, so `y = 2 * 1 * 3 / (1 + 2) = 2` above the start, once the set point has moved by 3."""
    loop = device(auto=True, gains=Gains(1.0, 0.0, 0.0))
    loop.set_point = 83.0
    loop.advance(500.0)
    assert loop.reading == pytest.approx(82.0)
    assert loop.output == pytest.approx(41.0)


def test_integral_action_reaches_the_set_point_and_stays_within_the_limits():
    loop = device(auto=True, set_point=80.0, gains=Gains(1.5, 10.0, 0.5), limits=(0.0, 60.0))
    loop.set_point = 110.0
    outputs = []
    for k in range(1, 3001):
        loop.advance(0.1 * k)
        outputs.append(loop.output)
    assert loop.reading == pytest.approx(110.0, abs=1e-6)
    assert max(outputs) <= 60.0


def test_the_integral_stands_still_at_a_limit():
    """The set point is out of reach for an hour; once it is back, the output leaves the limit within a dead time."""
    loop = device(auto=True, gains=Gains(1.0, 10.0, 0.0), limits=(0.0, 50.0))
    loop.set_point = 150.0
    loop.advance(3600.0)
    assert loop.output == 50.0
    loop.set_point = 90.0
    loop.advance(3601.5)
    assert loop.output < 50.0


def test_derivative_action_opposes_a_rising_reading():
    still, moving = device(gains=Gains(1.0, 0.0, 4.0)), device(gains=Gains(1.0, 0.0, 4.0))
    for loop in (still, moving):
        loop.command(40.0 if loop is still else 60.0)
        loop.advance(4.0)
        loop.auto = True
        loop.advance(5.0)
    assert still.output == pytest.approx(40.0)
    assert moving.output < 60.0


def test_a_reading_is_held_between_scans():
    loop = device(scan_s=1.0, sensors=[Noise(0.5, seed=3)])
    loop.advance(4.0)
    seen = loop.reading
    loop.advance(4.9)
    assert loop.reading == seen
    loop.advance(5.0)
    assert loop.reading != seen


def test_the_watchdog_takes_over_when_the_beats_stop_and_not_before():
    loop = device(watchdog=Watchdog(2.0, 10.0), scan_s=0.1)
    loop.command(45.0)
    loop.advance(100.0)
    assert (loop.output, loop.alarm) == (45.0, False)
    for beat in range(1, 21):
        loop.take_beat(beat)
        loop.advance(100.0 + beat)
    assert (loop.output, loop.alarm) == (45.0, False)
    loop.advance(120.9)
    assert not loop.alarm
    loop.advance(121.2)
    assert (loop.output, loop.alarm) == (10.0, True)


def test_a_beat_of_0_and_auto_call_the_watchdog_off():
    for call_off in (lambda loop: loop.take_beat(0), lambda loop: setattr(loop, "auto", True)):
        loop = device(watchdog=Watchdog(2.0, 10.0), gains=Gains(0.0, 0.0, 0.0))
        loop.take_beat(1)
        call_off(loop)
        loop.advance(60.0)
        assert (loop.output, loop.alarm) == (40.0, False)


def test_beats_come_back():
    loop = device(watchdog=Watchdog(2.0, 10.0))
    loop.take_beat(1)
    loop.advance(5.0)
    assert loop.alarm
    loop.take_beat(2)
    loop.command(50.0)
    loop.advance(6.0)
    assert (loop.output, loop.alarm) == (50.0, False)


@settings(deadline=None)
@given(cuts=st.lists(st.floats(0.0, 20.0), max_size=20))
def test_it_does_not_matter_how_often_it_is_asked(cuts):
    once = device(auto=True, set_point=85.0, gains=Gains(1.0, 8.0, 0.3), sensors=[Noise(0.1, seed=1)])
    often = device(auto=True, set_point=85.0, gains=Gains(1.0, 8.0, 0.3), sensors=[Noise(0.1, seed=1)])
    once.advance(20.0)
    for t in sorted(cuts):
        often.advance(t)
    often.advance(20.0)
    assert (often.reading, often.output, often.scans) == (once.reading, once.output, once.scans)


@pytest.mark.parametrize("scan_s", [0.0, -1.0, math.nan, math.inf])
def test_a_scan_that_cannot_be_is_refused(scan_s):
    with pytest.raises(ValueError, match="scan_s must be positive"):
        device(scan_s=scan_s)


def test_hand_worked_registers():
    loop = device(set_point=-12.3, gains=Gains(1234.5, 20.0, 0.0))
    loop.advance(0.55)
    assert plc_registers.input_words(loop) == [800, 400, 11, 0]
    words = plc_registers.holding_words(loop)
    assert words[:3] == [400, 65536 - 123, 0]
    # 1234.5 = 0x449A5000 and 20 = 0x41A00000 by IEEE 754
    assert words[10:] == [0x449A, 0x5000, 0x41A0, 0x0000, 0x0000, 0x0000]


def test_writes_reach_the_device():
    loop = device()
    assert plc_registers.write_holding(loop, 0, [415, 0xFFFF])
    assert plc_registers.write_holding(loop, 10, [0x449A, 0x5000, 0x41A0, 0x0000])
    assert (loop.output, loop.set_point) == (41.5, -0.1)
    assert loop.gains == Gains(1234.5, 20.0, 0.0)


@pytest.mark.parametrize("words", [[0x7FC0, 0x0000], [0x7F80, 0x0000], [0xC1A0, 0x0000]])
def test_an_integral_time_that_is_no_time_changes_nothing(words):
    loop = device()
    assert not plc_registers.write_holding(loop, 12, words)
    assert loop.gains == Gains()


def test_a_reading_beyond_its_register_shows_the_end():
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), pv0=1e6)
    assert plc_registers.input_words(LoopDevice(plant))[0] == 32767
