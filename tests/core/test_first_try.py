"""A simulated PLC without noise: each kind of plant is tuned at the first try, with the default settings."""

import pytest

from autotuner.application.analysis.procedure import identified
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.recording import Recording, Sample
from autotuner_sim.plants import Fopdt, Integrating, InverseResponse, SopdtOverdamped, SopdtUnderdamped, UnstableFopdt
from autotuner_sim.stepped import SteppedPlant

LONGEST = 40_000
PLANTS = [
    Fopdt(2.0, 10.0, 1.5),
    Fopdt(2.0, 1.0, 10.0),
    pytest.param(Fopdt(2.0, 300.0, 1.5), marks=pytest.mark.long),
    SopdtOverdamped(2.0, 10.0, 4.0, 1.5),
    SopdtUnderdamped(2.0, 9.0, 2.4, 1.5),
    Integrating(0.05, 2.0, 1.5),
    InverseResponse(2.0, 10.0, 4.0, 5.0, 1.5),
    pytest.param(InverseResponse(2.0, 10.0, 4.0, 12.0, 1.5), marks=pytest.mark.long),
    UnstableFopdt(2.0, 10.0, 1.5),
]


@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_each_kind_of_plant_is_tuned_at_the_first_try(plant):
    device = SteppedPlant(plant, output0=40.0, pv0=80.0)
    settings = ExperimentSettings(sample_time_s=0.2)
    experiment, samples, output = Experiment(settings, 40.0), [], 40.0
    for k in range(LONGEST):
        t = k * settings.sample_time_s
        device.advance(t)
        pv = device.measure()
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            break
        device.output = output = command.output
        samples.append(Sample(t, pv, output))
    assert experiment.phase is Phase.RESTORE
    assert experiment.verdict is None
    analysis = identified(Recording.from_samples(samples, experiment.settings_so_far()))
    assert analysis.gains is not None
    assert analysis.gains.margins.stable
    assert pytest.approx(plant.K, rel=0.05) == analysis.identification.model.K
    assert pytest.approx(plant.D, rel=0.05) == analysis.identification.model.D
