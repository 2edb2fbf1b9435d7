"""The controller of a device: what it cannot have is left out or refused, and judged as the device runs it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.design import FORMS, DeviceController, PidGains, Spans
from autotuner.core.model.process import Fopdt
from autotuner.errors import InputError

MODEL = Fopdt(2.0, 10.0, 2.0)
SPANS = Spans(200.0, 50.0)


def sensitivity(Kp, Ti, Td, Tf=0.0, N=math.inf):
    """Return the largest sensitivity on the process, by its definition on a dense grid."""
    s = 1j * np.geomspace(1e-3, 1e2, 200_000)
    C = Kp * (1.0 + 1.0 / (Ti * s) + Td * s / (1.0 + Td * s / N)) / (1.0 + Tf * s + (Tf * s) ** 2 / 2.0)
    return float(np.abs(1.0 / (1.0 + C * 2.0 * np.exp(-2.0 * s) / (10.0 * s + 1.0))).max())


@pytest.mark.parametrize("name", FORMS)
def test_only_the_series_form_limits_the_ratio_of_its_times(name):
    assert DeviceController(name).derivative_ratio == (0.25 if name == "series" else math.inf)


def test_three_numbers_are_taken_and_the_rest_is_the_device_s():
    device = DeviceController(b=0.4, N=8.0)
    assert device.as_run(PidGains(1.2, 9.0, 0.8, 0.1, 0.9)) == PidGains(1.2, 9.0, 0.8, 0.0, 0.4, 8.0)


@pytest.mark.parametrize("name", FORMS)
@given(st.floats(0.1, 1.2), st.floats(5.0, 40.0), st.floats(0.0, 0.1), st.floats(0.0, 1.0))
@settings(max_examples=8, deadline=None)
def test_a_device_of_any_form_holds_its_own_controller(name, Kp, Ti, ratio, b):
    wanted = PidGains(Kp, Ti, ratio * Ti, 0.1)
    held = DeviceController(name, b=b, N=6.0, spans=SPANS).held(wanted)
    assert (held.gains.Kp, held.gains.Ti, held.gains.Td) == pytest.approx((Kp, Ti, ratio * Ti), rel=1e-9)
    assert (held.gains.Tf, held.gains.b, held.gains.N) == (0.0, b, 6.0)


def test_margins_are_those_of_the_rounded_numbers_with_the_filter_of_the_device():
    """1.13 -> 1.2, 6.4 s -> 6 s, 0.83 s -> 1 s; `Tf` is not a setting, the derivative is filtered by `Td/8`."""
    device = DeviceController(N=8.0, resolution={"gain": 0.2, "integral": 2.0, "derivative": 0.5})
    held = device.held(PidGains(1.13, 6.4, 0.83, 0.3), MODEL)
    assert held.labelled == pytest.approx({"Kp": 1.2, "Ti": 6.0, "Td": 1.0})
    assert held.margins.Ms == pytest.approx(sensitivity(1.2, 6.0, 1.0, N=8.0), rel=1e-5)
    before = sensitivity(1.13, 6.4, 0.83, Tf=0.3)
    assert bool(held.warnings) is (held.margins.Ms > 1.02 * before)


def test_a_derivative_that_the_device_lacks_is_refused_and_none_is_no_matter():
    device = DeviceController(derivative=False)
    with pytest.raises(InputError) as refused:
        device.held(PidGains(1.0, 10.0, 1.0))
    assert refused.value.field == "gains.Td"
    assert refused.value.value == 1.0
    assert device.held(PidGains(1.0, 10.0)).gains == PidGains(1.0, 10.0)


def test_a_form_with_spans_needs_them():
    with pytest.raises(InputError) as refused:
        DeviceController("eurotherm").held(PidGains(1.0, 10.0))
    assert refused.value.field == "spans.pv"
    with pytest.raises(InputError) as refused:
        DeviceController("eurotherm", spans=Spans(pv=100.0)).held(PidGains(1.0, 10.0))
    assert refused.value.field == "spans.output"


@given(st.floats(0.1, 5.0), st.floats(5.0, 50.0))
def test_the_span_of_the_display_scales_the_band(Kp, Ti):
    """Half the span needs twice the band in per cent for the same controller; a band in units does not change."""
    whole, half = Spans(100.0, 100.0), Spans(50.0, 100.0)
    for name, factor in (("eurotherm", 2.0), ("eurotherm_units", 1.0)):
        wide, narrow = (DeviceController(name, spans=spans).held(PidGains(-Kp, Ti)) for spans in (whole, half))
        assert narrow.device.gain == pytest.approx(factor * wide.device.gain)
        assert narrow.gains.Kp == pytest.approx(-Kp)


def test_no_integral_action_is_written_as_the_device_writes_it():
    """0 stands for none in most devices; CODESYS allows no 0 and gets a time of 30 years."""
    for name, form in FORMS.items():
        held = DeviceController(name, spans=SPANS).held(PidGains(1.0))
        assert held.device.integral == (1e9 if name == "codesys" else 0.0)
        assert math.isinf(held.gains.Ti)
        assert held.labelled[form.labels[1]] == held.device.integral
