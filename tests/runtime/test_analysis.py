"""A model that does not explain its record gets no gains, however it came about."""

import numpy as np
import pytest

from autotuner.core.recording import Recording
from autotuner.runtime.analysis import analyse


@pytest.fixture
def recording(rig, virtual):
    """The record of a tuning of the plant K 2, T 10 s, D 1.5 s; its relay part is that before `half_relay`."""
    one = rig()
    virtual(one.conduct())
    return one.tuning.recording()


def test_a_model_that_explains_its_record_gets_gains(recording):
    analysis = analyse(recording)
    assert analysis.verdict.code == "identified"
    assert analysis.gains is not None


def test_a_record_in_which_something_else_moved_the_pv_gets_none(recording):
    """A load as large as the relay's own, with a period that is not the relay's."""
    load = 6.0 * np.sin(2.0 * np.pi * recording.t / 23.0)
    spoiled = Recording(recording.t, recording.output, recording.pv + load, settings=recording.settings)
    analysis = analyse(spoiled)
    assert analysis.verdict.code != "identified"
    assert analysis.gains is None
    assert analysis.verdict.remedy


def test_a_model_that_is_worse_than_none_on_the_check_gets_none(rig, virtual):
    """An actuator that is stuck at 35 and 45: on the relay's record an unstable process looks the same."""
    one = rig(device={"effects": [{"effect": "saturation", "low": 35.0, "high": 45.0}]})
    verdict = virtual(one.conduct())
    assert verdict.code == "record_unexplained"
    assert one.tuning.analysis.gains is None
    assert one.tuning.analysis.identification.model is not None  # kept, for who wants to look


def test_without_the_check_the_record_itself_is_judged(recording):
    load = 6.0 * np.sin(2.0 * np.pi * recording.t / 23.0)
    alone = Recording(recording.t, recording.output, recording.pv + load)
    assert analyse(alone).gains is None
