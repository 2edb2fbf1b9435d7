import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import Action, PidGains, controller_response, gains_from_dict
from autotuner.errors import InputError


def test_controller_is_named_by_its_parts():
    assert PidGains(1.0).controller == "P"
    assert PidGains(1.0, 2.0).controller == "PI"
    assert PidGains(1.0, 2.0, 0.5).controller == "PID"
    assert PidGains(1.0, Td=0.5).controller == "PD"


def test_sign_of_the_gain_is_the_action():
    assert PidGains(2.0).action is Action.REVERSE
    assert PidGains(-2.0).action is Action.DIRECT


def test_parallel_gains_follow_from_the_times():
    gains = PidGains(3.0, 6.0, 0.5)
    assert (gains.Ki, gains.Kd) == (0.5, 1.5)
    assert PidGains(3.0).Ki == 0.0


def test_dictionary_is_json_without_infinity():
    text = json.dumps(PidGains(2.0).to_dict(), allow_nan=False)
    assert json.loads(text) == {"controller": "P", "Kp": 2.0, "Ti": None, "Td": 0.0, "Tf": 0.0, "b": 1.0, "N": None}


@given(st.floats(0.01, 100.0), st.one_of(st.just(math.inf), st.floats(0.01, 100.0)), st.floats(0.0, 10.0))
def test_dictionary_there_and_back(Kp, Ti, Td):
    gains = PidGains(-Kp, Ti, Td, 0.25, 0.5)
    assert gains_from_dict(json.loads(json.dumps(gains.to_dict()))) == gains


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"Kp": 0.0}, "gains.Kp"),
        ({"Kp": math.nan}, "gains.Kp"),
        ({"Kp": 1.0, "Ti": 0.0}, "gains.Ti"),
        ({"Kp": 1.0, "Ti": math.nan}, "gains.Ti"),
        ({"Kp": 1.0, "Td": -1.0}, "gains.Td"),
        ({"Kp": 1.0, "Tf": math.inf}, "gains.Tf"),
        ({"Kp": 1.0, "b": math.nan}, "gains.b"),
        ({"Kp": "fast"}, "gains.Kp"),
        ({"Kp": True}, "gains.Kp"),
        ({}, "gains.Kp"),
        ({"Kp": 1.0, "Ki": 2.0}, "gains.Ki"),
    ],
)
def test_gains_that_cannot_exist_are_refused_by_name(values, field):
    with pytest.raises(InputError) as caught:
        gains_from_dict(values)
    assert caught.value.field == field
    assert caught.value.remedy


def test_response_by_hand():
    # At w = 1: 2 (1 + 1/(4j) + 0.5j) = 2 + 0.5j; the filter with Tf = 1 is 1/(1 + j - 1/2) = 1/(0.5 + j).
    response = controller_response(PidGains(2.0, 4.0, 0.5, 1.0), np.array([1.0]))[0]
    assert response == pytest.approx((2.0 + 0.5j) / (0.5 + 1.0j), rel=1e-14)
