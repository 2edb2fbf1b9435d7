import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from autotuner.core.design import (
    FORMS,
    Action,
    DeviceGains,
    PidGains,
    Spans,
    controller_response,
    form_named,
    from_device,
    rounded,
    to_device,
)
from autotuner.errors import InputError

SPANS = Spans(pv=200.0, output=50.0)
FREQUENCIES = np.geomspace(1e-4, 1e4, 81)


@pytest.mark.parametrize("name", FORMS)
@given(data=st.data())
def test_there_and_back_is_the_same_controller(any_gains, name, data):
    gains = data.draw(any_gains)
    back = from_device(to_device(gains, FORMS[name], SPANS), FORMS[name], SPANS)
    assert (back.b, back.Tf, back.action) == (gains.b, gains.Tf, gains.action)
    assert math.isinf(back.Ti) == math.isinf(gains.Ti)
    ours, theirs = controller_response(gains, FREQUENCIES), controller_response(back, FREQUENCIES)
    assert np.max(np.abs(ours - theirs) / np.abs(ours)) < 1e-9


@given(st.floats(0.01, 100.0), st.floats(0.1, 100.0), st.floats(0.0, 0.25))
def test_series_form_is_the_product_it_says(Kp, Ti, ratio):
    Td = ratio * Ti
    series = to_device(PidGains(Kp, Ti, Td), FORMS["series"])
    s = 1j * FREQUENCIES
    product = series.gain * (1.0 + 1.0 / (s * series.integral)) * (1.0 + s * series.derivative)
    np.testing.assert_allclose(product, Kp * (1.0 + 1.0 / (s * Ti) + s * Td), rtol=1e-9)


@given(st.floats(1.0, 100.0), st.floats(0.2501, 10.0))
def test_series_form_does_not_exist_above_a_quarter(Ti, ratio):
    with pytest.raises(InputError, match="Ti >= 4 Td") as caught:
        to_device(PidGains(1.0, Ti, ratio * Ti), FORMS["series"])
    assert caught.value.field == "gains.Td"


# Kp = 2 output/PV, Ti = 60 s, Td = 12 s on spans of 200 (PV) and 50 (output): gain in percent per percent is
# 2 * 200/50 = 8, the band 100/8 = 12.5 %, the gain in percent of output per unit of PV is 2 * 100/50 = 4.
# Series: x = sqrt(1 - 4*12/60) = sqrt(0.2) = 0.4472136, (1 + x)/2 = 0.7236068.
BY_HAND = {
    "ideal": (2.0, 60.0, 12.0),
    "ideal_minutes": (2.0, 1.0, 0.2),
    "ideal_repeats_per_minute": (2.0, 1.0, 0.2),
    "parallel": (2.0, 2.0 / 60.0, 24.0),
    "series": (1.4472136, 43.416408, 16.583592),
    "proportional_band": (12.5, 60.0, 12.0),
    "siemens_pid_compact": (4.0, 60.0, 12.0),
    "rockwell_pide_independent": (8.0, 8.0, 1.6),
    "rockwell_pide_dependent": (8.0, 1.0, 0.2),
    "schneider_pidff": (8.0, 60000.0, 12000.0),
    "eurotherm": (12.5, 60.0, 12.0),
    "eurotherm_units": (25.0, 60.0, 12.0),
    "omron_e5c": (25.0, 60.0, 12.0),
    "omron_e5c_analog": (12.5, 60.0, 12.0),
    "yokogawa": (12.5, 60.0, 12.0),
    "west": (12.5, 60.0, 12.0),
    "codesys": (2.0, 60.0, 12.0),
    "tclab": (4.0, 60.0, 12.0),
    "arduino_pid": (10.2, 0.17, 122.4),
    "esphome": (0.04, 0.04 / 60.0, 0.48),
    "klipper": (10.2, 0.17, 122.4),
    "marlin": (10.2, 0.17, 122.4),
}


@pytest.mark.parametrize("name", FORMS)
def test_presets_by_hand(name):
    device = to_device(PidGains(2.0, 60.0, 12.0), form_named(name), SPANS)
    assert (device.gain, device.integral, device.derivative) == pytest.approx(BY_HAND[name], rel=1e-7)


# What each maker publishes of the output, as a share of the full output, for an error e, its integral s and its rate r.
# e, s and r are in engineering units on a span of 200; times in s.


def percent(value):
    return 100.0 * value / 200.0


def band(PB, Ti, Td, e, s, r):
    """100 % of output for an error as wide as the band."""
    return (e + s / Ti + Td * r) / PB


PUBLISHED = {
    "siemens_pid_compact": lambda K, Ti, Td, e, s, r: K * (e + s / Ti + Td * r) / 100.0,
    "rockwell_pide_independent": lambda p, i, d, e, s, r: (
        (p * percent(e) + i / 60.0 * percent(s) + 60.0 * d * percent(r)) / 100.0
    ),
    "rockwell_pide_dependent": lambda p, i, d, e, s, r: (
        (p * (percent(e) + percent(s) / (60.0 * i) + 60.0 * d * percent(r))) / 100.0
    ),
    "schneider_pidff": lambda K, ti, td, e, s, r: K * (e + 1000.0 * s / ti + td / 1000.0 * r) / 200.0,
    "eurotherm": lambda PB, ti, td, e, s, r: band(PB, ti, td, percent(e), percent(s), percent(r)),
    "eurotherm_units": band,
    "omron_e5c": band,
    "omron_e5c_analog": lambda p, i, d, e, s, r: band(p, i, d, percent(e), percent(s), percent(r)),
    "yokogawa": lambda p, i, d, e, s, r: band(p, i, d, percent(e), percent(s), percent(r)),
    "west": lambda p, i, d, e, s, r: band(p, i, d, percent(e), percent(s), percent(r)),
    "codesys": lambda K, TN, TV, e, s, r: K * (e + s / TN + TV * r) / 50.0,
    "tclab": lambda K, tauI, tauD, e, s, r: (K * e + K / tauI * s + K * tauD * r) / 100.0,
    "arduino_pid": lambda kp, ki, kd, e, s, r: (kp * e + ki * s + kd * r) / 255.0,
    "esphome": lambda kp, ki, kd, e, s, r: kp * e + ki * s + kd * r,
    "klipper": lambda kp, ki, kd, e, s, r: kp / 255.0 * e + ki / 255.0 * s + kd / 255.0 * r,
    "marlin": lambda p, i, d, e, s, r: (p * e + i * s + d * r) / 255.0,
}
"""Klipper: heaters.py divides its numbers by 255, its output goes from 0 to 1. Marlin: temperature.cpp, counts."""


@pytest.mark.parametrize("name", PUBLISHED)
@given(st.floats(0.1, 20.0), st.floats(1.0, 500.0), st.floats(0.0, 0.25), st.floats(-9.0, 9.0), st.floats(-1.0, 1.0))
def test_the_formula_of_the_maker_gives_the_output_of_the_ideal_form(name, Kp, Ti, ratio, e, r):
    gains = PidGains(Kp, Ti, ratio * Ti)
    device = to_device(gains, FORMS[name], SPANS)
    s = 3.0 * e + 4.5 * r
    published = 50.0 * PUBLISHED[name](device.gain, device.integral, device.derivative, e, s, r)
    assert published == pytest.approx(Kp * (e + s / Ti + ratio * Ti * r), rel=1e-9, abs=1e-9)


DEVICES = set(PUBLISHED)


def test_every_form_is_a_textbook_one_or_has_the_formula_of_its_maker():
    assert {name for name, form in FORMS.items() if "Advanced PID Control" not in form.source} == DEVICES


@pytest.mark.parametrize("name", sorted(DEVICES - {"yokogawa"}))
def test_a_device_says_how_its_mode_is_changed(name):
    mode = FORMS[name].mode
    assert mode is not None
    assert not set(mode.auto) & set(mode.manual)
    assert bool(mode.auto) == bool(mode.manual)
    assert mode.manual_output or mode.note


def test_numbers_carry_the_names_of_the_device():
    device = to_device(PidGains(2.0, 60.0, 12.0), FORMS["eurotherm"], SPANS)
    assert device.labelled(FORMS["eurotherm"]) == {"Pb": 12.5, "ti": 60.0, "td": 12.0}


def test_direct_action_is_a_sign_or_a_setting():
    signed = to_device(PidGains(-2.0, 60.0, 12.0), FORMS["parallel"])
    assert (signed.gain, signed.derivative) == (-2.0, -24.0)
    unsigned = to_device(PidGains(-2.0, 60.0, 12.0), FORMS["eurotherm"], SPANS)
    assert (unsigned.gain, unsigned.action) == (12.5, Action.DIRECT)


def test_integral_off_is_zero_in_the_device():
    assert to_device(PidGains(2.0), FORMS["siemens_pid_compact"], SPANS).integral == 0.0


def test_rounding_is_shown_and_bounded():
    exact = to_device(PidGains(2.0, 61.3, 12.0), FORMS["eurotherm"], SPANS)
    held = rounded(exact, {"gain": 0.1, "integral": 1.0, "derivative": 1.0})
    assert (held.gain, held.integral, held.derivative) == pytest.approx((12.5, 61.0, 12.0))


@given(st.floats(0.1, 1000.0), st.floats(1e-3, 0.05))
def test_rounding_moves_no_number_by_more_than_half_a_step(value, step):
    held = rounded(DeviceGains(value, value, value), dict.fromkeys(("gain", "integral", "derivative"), step))
    for number in (held.gain, held.integral, held.derivative):
        assert abs(number - value) <= step / 2.0 * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("resolution", "field"),
    [
        ({"gain": 1000.0}, "gains.gain"),
        ({"gain": 0.0}, "resolution.gain"),
        ({"gain": math.nan}, "resolution.gain"),
        ({"bias": 1.0}, "resolution.bias"),
    ],
)
def test_rounding_away_a_gain_is_refused(resolution, field):
    with pytest.raises(InputError) as caught:
        rounded(DeviceGains(2.0, 60.0, 12.0), resolution)
    assert caught.value.field == field


@pytest.mark.parametrize("span", [None, 0.0, -5.0, math.nan, math.inf])
def test_a_missing_span_is_named(span):
    with pytest.raises(InputError) as caught:
        to_device(PidGains(1.0, 1.0), FORMS["yokogawa"], Spans(pv=span, output=100.0))
    assert caught.value.field == "spans.pv"


@pytest.mark.parametrize(
    ("form", "device", "field"),
    [
        ("eurotherm", DeviceGains(-12.5, 60.0, 12.0), "gains.gain"),
        ("eurotherm", DeviceGains(0.0, 60.0, 12.0), "gains.gain"),
        ("eurotherm", DeviceGains(12.5, -60.0, 12.0), "gains.integral"),
        ("parallel", DeviceGains(-2.0, 0.1, -3.0), "gains.integral"),
        ("parallel", DeviceGains(2.0, 0.1, math.nan), "gains.derivative"),
        ("ideal", DeviceGains(-2.0, -60.0, 1.0), "gains.integral"),
    ],
)
def test_numbers_that_are_no_controller_are_refused(form, device, field):
    with pytest.raises(InputError) as caught:
        from_device(device, FORMS[form], SPANS)
    assert caught.value.field == field


def test_unknown_form_lists_the_known_ones():
    with pytest.raises(InputError, match="siemens_pid_compact"):
        form_named("honeywell")


@given(st.floats(0.1, 10.0), st.floats(1.0, 100.0), st.floats(0.0, 0.24))
def test_published_series_conversion_reverses(Kc, Ti, ratio):
    # Kp = Kc (Ti + Td)/Ti, Ti + Td, Ti Td/(Ti + Td): the textbook's own direction, from series to ideal.
    Td = ratio * Ti
    assume(Td <= Ti)
    ideal = from_device(DeviceGains(Kc, Ti, Td), FORMS["series"])
    assert (ideal.Kp, ideal.Ti, ideal.Td) == pytest.approx((Kc * (Ti + Td) / Ti, Ti + Td, Ti * Td / (Ti + Td)))
