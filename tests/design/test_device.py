import json

import pytest

from autotuner.core.design import PidGains, Spans, margins
from autotuner.core.design.forms.held_gains import held_by_device
from autotuner.core.model.process import Fopdt
from autotuner.errors import InputError

MODEL = Fopdt(2.0, 10.0, 2.0)
WANTED = PidGains(1.13, 6.4, 0.83, 0.083)


def test_a_fine_device_holds_what_is_wanted():
    held = held_by_device(WANTED, "ideal", model=MODEL)
    assert held.gains == WANTED
    assert held.margins == margins(MODEL, WANTED)
    assert held.warnings == ()


def test_rounding_by_hand():
    # Band 100/(1.13 * 100/100) = 88.4956 % -> 88.5; 6.4 s -> 6; 0.83 s -> 1.
    held = held_by_device(
        WANTED,
        "eurotherm",
        spans=Spans(100.0, 100.0),
        resolution={"gain": 0.1, "integral": 1.0, "derivative": 1.0},
        model=MODEL,
    )
    assert held.labelled == pytest.approx({"Pb": 88.5, "ti": 6.0, "td": 1.0})
    assert (held.gains.Kp, held.gains.Ti, held.gains.Td) == pytest.approx((100.0 / 88.5, 6.0, 1.0))
    assert held.margins == margins(MODEL, held.gains)
    json.dumps(held.to_dict(), allow_nan=False)


def test_what_rounding_costs_is_said():
    worse = held_by_device(PidGains(1.13, 5.9, 0.83, 0.083), "ideal", resolution={"integral": 4.0}, model=MODEL)
    assert worse.gains.Ti == 4.0
    assert "have Ms 1.51 instead of 1.36" in worse.warnings[0]
    # Ku of this process is about 4.25: 2.0 is stable, 4.5 is not.
    lost = held_by_device(PidGains(2.3, 60.0), "ideal", resolution={"gain": 4.5}, model=MODEL)
    assert lost.gains.Kp == 4.5
    assert "unstable" in lost.warnings[0]


def test_without_a_model_nothing_is_judged():
    assert held_by_device(WANTED, "ideal").margins is None


def test_what_a_form_cannot_hold_is_refused():
    with pytest.raises(InputError, match="Ti >= 4 Td"):
        held_by_device(PidGains(1.0, 2.0, 1.0), "series")
