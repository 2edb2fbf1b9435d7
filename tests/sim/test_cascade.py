"""The cascade of the simulator against closed forms."""

import numpy as np
import pytest

from autotuner_sim import Fopdt, SteppedPlant
from autotuner_sim.cascade import OuterDevice
from autotuner_sim.devices.loop_device import Gains, LoopDevice

K1, T1, K2, T2 = 2.0, 3.0, 0.5, 20.0
SCAN_S = 0.01


def pair(**settings):
    inner = LoopDevice(SteppedPlant(Fopdt(K1, T1, 0.0), output0=10.0, pv0=30.0), scan_s=SCAN_S, **settings)
    process = SteppedPlant(Fopdt(K2, T2, 0.0), output0=30.0, pv0=70.0)
    return inner, OuterDevice(inner, process, scan_s=1.0), process


def test_with_the_inner_loop_in_manual_it_is_two_lags_in_series():
    inner, outer, process = pair()
    inner.command(11.0)
    for t in np.arange(1.0, 100.0, 7.0):
        outer.advance(t)
        two_lags = 1.0 - (T2 * np.exp(-t / T2) - T1 * np.exp(-t / T1)) / (T2 - T1)
        assert process.pv - 70.0 == pytest.approx(K1 * K2 * two_lags, abs=K1 * K2 * SCAN_S / T1)


def test_with_the_inner_loop_in_auto_its_set_point_is_the_output():
    inner, outer, process = pair(gains=Gains(5.0, 1.0), auto=True)
    outer.command(34.0)
    outer.advance(400.0)
    assert inner.set_point == outer.output == 34.0
    assert outer.position == pytest.approx(34.0, abs=1e-6)
    assert process.pv - 70.0 == pytest.approx(4.0 * K2, rel=1e-6)


def test_it_does_not_matter_which_loop_is_looked_at():
    by_outer, by_inner = pair(), pair()
    for inner, _, _ in (by_outer, by_inner):
        inner.command(12.0)
    by_outer[1].advance(40.0)
    for t in np.arange(0.5, 40.5, 0.5):
        by_inner[0].advance(t)
    assert by_inner[2].pv == pytest.approx(by_outer[2].pv, abs=1e-9)
