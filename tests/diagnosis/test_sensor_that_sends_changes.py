"""Readings that a sensor sends on change: the process is the simulator's, and the reading repeats what was sent last.

A repeated reading lags behind the PV like play, so that a process fitted to it has too small a gain.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.record.sensor import new_readings
from tests.diagnosis.simulated import LAG, PAIR, moves, record

pytestmark = pytest.mark.usefixtures("without_gains")


def sent_on_change(whole, least, sigma=0.01):
    """Return the record as a sensor sends it that is silent until the PV has moved by `least`."""
    noisy = whole.pv + sigma * np.random.default_rng(7).normal(size=whole.pv.size)
    sent = [float(noisy[0])]
    for value in noisy[1:].tolist():
        sent.append(value if abs(value - sent[-1]) >= least else sent[-1])
    return Recording(whole.t, whole.output, np.array(sent))


@pytest.mark.parametrize("step", [0.1, 0.015])
@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_the_process_is_that_of_the_readings_which_were_sent(plant, step):
    """Steps of a tenth of the PV's motion; or of 1.5 %, by which the PV moves at most samples."""
    whole = record(plant, moves(600, hold=20))
    coarse = sent_on_change(whole, step * float(np.ptp(whole.pv)))
    found = diagnose(coarse)
    assert found.verdict == "explained"
    assert [effect.name for effect in found.effects] == ["sensor_quantisation"]
    low, high = found.to_dict()["model"]["after"]["interval95"]["K"]
    assert low <= plant.K <= high
    assert pytest.approx(found.process.K, rel=0.005) == plant.K


def test_a_few_readings_show_no_process():
    whole = record(LAG, moves(300, hold=60))
    coarse = sent_on_change(whole, 0.35 * float(np.ptp(whole.pv)))
    count = int(np.count_nonzero(new_readings(coarse.pv)))
    assert count < 20
    found = diagnose(coarse)
    assert found.verdict != "explained"
    assert any("new readings only" in note for note in found.notes)
