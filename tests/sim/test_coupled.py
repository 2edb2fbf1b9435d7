"""Two loops of the simulator that disturb each other, against closed forms."""

import math

import pytest

from autotuner_sim import Fopdt, SopdtOverdamped
from autotuner_sim.coupled import coupled_plants
from autotuner_sim.devices.plant_options import build_plant

OWN = (Fopdt(2.0, 10.0, 1.0), Fopdt(1.0, 8.0, 1.0))
CROSS = (SopdtOverdamped(0.5, 12.0, 0.0, 2.0), SopdtOverdamped(-0.4, 6.0, 0.0, 3.0))


def lag(K, T, t):
    return K * (1.0 - math.exp(-t / T)) if t > 0.0 else 0.0


def test_each_output_moves_both_pvs():
    first, second = coupled_plants(OWN, CROSS, output0=(40.0, 30.0), pv0=(60.0, 50.0))
    for plant in (first, second):
        plant.advance(5.0)
    first.output = 43.0
    for plant in (first, second):
        plant.advance(9.0)
    second.output = 28.0
    for t in (9.5, 12.0, 25.0, 60.0):
        first.advance(t)
        second.advance(t)
        one = 60.0 + 3.0 * lag(2.0, 10.0, t - 6.0) - 2.0 * lag(0.5, 12.0, t - 11.0)
        other = 50.0 - 2.0 * lag(1.0, 8.0, t - 10.0) + 3.0 * lag(-0.4, 6.0, t - 8.0)
        assert first.pv == pytest.approx(one, rel=1e-12)
        assert second.pv == pytest.approx(other, rel=1e-12)


def test_a_pair_does_not_hear_another_pair():
    first, _ = coupled_plants(OWN, CROSS)
    _, other = coupled_plants(OWN, CROSS)
    first.output = 10.0
    first.advance(50.0)
    other.advance(50.0)
    assert other.pv == 0.0


def test_loops_of_a_configuration_are_joined_by_the_number_of_a_wire():
    plant = {"K": 1.0, "T": 5.0, "D": 0.0}
    heard = {"wire": 7.0, "K": 0.5, "T1": 4.0, "D": 1.0, "output0": 20.0}
    hearing = build_plant("fopdt", plant, pv0=30.0, with_effects=[("hears", heard)])
    sending = build_plant("fopdt", plant, output0=20.0, with_effects=[("sends", {"wire": 7.0})])
    sending.advance(2.0)
    sending.output = 24.0
    hearing.advance(10.0)
    assert hearing.pv == pytest.approx(30.0 + 4.0 * lag(0.5, 4.0, 7.0), rel=1e-12)
