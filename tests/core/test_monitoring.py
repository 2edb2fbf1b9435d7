"""A loop in its normal running: what a window says, on simulated loops under a PI controller."""

import math

import numpy as np
import pytest

from autotuner.core.design import PidGains
from autotuner.core.model.process import Fopdt
from autotuner.core.monitoring import Expected, findings, oscillation_of
from autotuner.core.recording import Recording
from autotuner_sim import Backlash, HeStiction, LoadStep, Noise, PeriodicLoad, SteppedPlant, Stiction
from autotuner_sim import Fopdt as Plant

MODEL = Fopdt(2.0, 10.0, 1.5)
GAINS = PidGains(1.6, 10.0, 0.0)
INTERVALS = {"K": (1.95, 2.05), "T": (9.7, 10.3), "D": (1.48, 1.52)}
EXPECTED = Expected(MODEL, INTERVALS, GAINS)
DT = 0.2
PLANT = Plant(2.0, 10.0, 1.5)


def running(plant=PLANT, moves=(0.0,), seconds=240.0, gains=GAINS, **hidden):
    """Return a window of a loop; `moves` are set points about 80, each held for its share of the window."""
    process = SteppedPlant(plant, output0=40.0, pv0=80.0, sensors=[Noise(0.05, seed=3)], **hidden)
    rows, total = [], 0.0
    for k in range(int(seconds / DT)):
        process.advance(k * DT)
        pv, set_point = process.measure(), 80.0 + moves[int(k * DT / seconds * len(moves))]
        total += (set_point - pv) * DT
        process.output = min(max(40.0 + gains.Kp * (set_point - pv + total / gains.Ti), 0.0), 100.0)
        rows.append((k * DT, process.output, pv, set_point))
    t, u, y, sp = (np.array(column) for column in zip(*rows, strict=True))
    return Recording(t, u, y, sp)


STEPS = (0.0, 5.0, -3.0, 4.0)
EAGER = PidGains(1.6, 5.0, 0.0)
"""Integral action for which friction is a limit cycle of some periods a window."""
MOVED_ONCE = (0.0, 3.0, 3.0, 3.0, 3.0, 3.0)


@pytest.mark.parametrize("moves", [(0.0,), STEPS])
def test_a_loop_that_is_as_it_was(moves):
    told = findings(running(moves=moves), EXPECTED)
    assert told.code == ("as_expected" if len(moves) > 1 else "at_rest")
    assert told.error == pytest.approx(0.05, rel=0.1)
    assert told.remedy == ""


@pytest.mark.parametrize(
    ("name", "plant"), [("K", Plant(3.0, 10.0, 1.5)), ("T", Plant(2.0, 5.0, 1.5)), ("D", Plant(2.0, 10.0, 3.0))]
)
def test_a_process_that_has_changed_is_told_with_its_numbers(name, plant):
    told = findings(running(plant, STEPS), EXPECTED)
    truth = {"K": plant.K, "T": plant.T, "D": plant.D}
    assert told.code == "retune_advised"
    for parameter, change in told.process.items():
        assert change.found == pytest.approx(truth[parameter], rel=0.02)
        assert change.expected == MODEL.parameters()[parameter]
    assert f"{name} is" in told.message
    assert told.Ms[1] > told.Ms[0]


@pytest.mark.one_of(2)
@pytest.mark.parametrize("moves", [(0.0,), STEPS])
def test_a_load_never_advises_to_tune_again(moves):
    told = findings(running(moves=moves, loads=[LoadStep(60.0, -8.0)]), EXPECTED)
    assert told.code == "disturbed"
    assert told.error > 20.0 * told.noise


def test_another_process_under_loads_alone_is_not_claimed():
    told = findings(running(Plant(3.0, 10.0, 1.5), loads=[LoadStep(60.0, -8.0)]), EXPECTED)
    assert told.code == "disturbed"
    assert told.process == {}
    assert "did not move enough" in told.notes[0]


def test_a_loop_that_hunts():
    told = findings(running(gains=PidGains(5.2, 10.0, 0.0)), EXPECTED)
    assert told.code == "retune_advised"
    assert "hunts" in told.message


@pytest.mark.parametrize(
    "actuator",
    [Stiction(3.0), *(pytest.param(a, marks=pytest.mark.long) for a in (HeStiction(3.0, 0.5), Backlash(3.0)))],
)
def test_an_actuator_that_sticks_or_has_play(actuator):
    loop = running(moves=MOVED_ONCE, seconds=900.0, gains=EAGER, actuators=[actuator])
    told = findings(loop, Expected(MODEL, INTERVALS, EAGER))
    assert told.code == "valve_sticking"
    assert set(told.effects) <= {"backlash", "stiction"}
    assert told.to_dict()["oscillation"]["regularity"] > 1.0


@pytest.mark.parametrize("period_s", [15.0, 40.0, 60.0])
def test_a_wave_from_outside_is_no_friction(period_s):
    told = findings(running(seconds=600.0, loads=[PeriodicLoad(5.0, period_s)]), EXPECTED)
    assert told.code == "disturbed"
    assert told.oscillation.period_s == pytest.approx(period_s, rel=0.02)


def test_an_oscillation_is_measured_under_noise():
    t = np.arange(0.0, 200.0, 0.5)
    noise = np.random.default_rng(1).normal(0.0, 0.3, t.size)
    found = oscillation_of(t, 2.0 * np.sin(2.0 * math.pi * t / 25.0) + noise + 0.01 * t)
    assert found.period_s == pytest.approx(25.0, rel=0.01)
    assert found.amplitude == pytest.approx(2.0, rel=0.05)
    assert oscillation_of(t, noise) is None
    assert oscillation_of(t, np.exp(-t / 20.0)) is None
    assert oscillation_of(t, np.zeros_like(t)) is None
