"""Single wild readings of the PV: what a damaged digit makes, which no process can."""

import pytest

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.recording import Sample
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

K, T, D = 2.0, 10.0, 1.5
SETTINGS = ExperimentSettings(sample_time_s=0.1, amplitude=10.0)
LONGEST_S = 2_000.0


def conduct(wild):
    """Run an experiment whose PV reads 40 too much in the samples `wild`; return it and when it ended, s."""
    plant = SteppedPlant(Fopdt(K, T, D), output0=40.0, pv0=80.0, sensors=[Noise(0.05, seed=1)])
    experiment, output = Experiment(SETTINGS, 40.0), 40.0
    for k in range(int(LONGEST_S / SETTINGS.sample_time_s)):
        t = k * SETTINGS.sample_time_s
        plant.advance(t)
        command = experiment.step(Sample(t, plant.measure() + (40.0 if k in wild else 0.0), output))
        plant.output = output = command.output
        if command.phase is Phase.RESTORE:
            return experiment, t
    raise AssertionError("the experiment did not end")


@pytest.mark.parametrize("first", range(200, 320, 10))
def test_a_wild_reading_does_not_move_the_relay_away(first):
    experiment, _ = conduct({first, first + 67})
    seen = experiment.settings_so_far()
    assert abs(seen["relay_reference"] - 80.0) < 5.0
    assert abs(0.5 * (seen["relay_low"] + seen["relay_high"]) - 40.0) < 10.0


@pytest.mark.parametrize("every", [13, 29, 51])
def test_a_line_full_of_them_ends_in_time(every):
    """With a known half period, waiting is bounded by it, under a relay that was moved as well."""
    _, ended_s = conduct(set(range(200, 20_000, every)))
    assert ended_s < 600.0
