"""A stable process that a load moved during the test looks unstable; it gets no gains for an unstable one."""

import pytest

from autotuner.application.analysis.procedure import identified
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.identification import identify
from autotuner.core.recording import Recording, Sample
from autotuner_sim import LoadRamp, LoadStep
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt, Integrating, UnstableFopdt
from autotuner_sim.stepped import SteppedPlant

SAMPLE_S = 0.2


def relay_record(plant, *loads):
    """The record of a relay test without a check."""
    device = SteppedPlant(plant, output0=40.0, pv0=80.0, sensors=[Noise(0.02, seed=1)], loads=list(loads))
    settings = ExperimentSettings(sample_time_s=SAMPLE_S, amplitude=10.0, hysteresis=0.1, check=False)
    experiment, output, samples = Experiment(settings, 40.0), 40.0, []
    while experiment.phase is not Phase.RESTORE:
        t = len(samples) * SAMPLE_S
        device.advance(t)
        pv = device.measure()
        device.output = output = experiment.step(Sample(t, pv, output)).output
        samples.append(Sample(t, pv, output))
    assert experiment.verdict is None
    return Recording.from_samples(samples, settings=experiment.settings_so_far())


@pytest.mark.parametrize(
    ("plant", "load"),
    [
        pytest.param(Fopdt(6.0, 60.0, 2.0), LoadRamp(20.0, -6.0, 30.0), marks=pytest.mark.long),
        pytest.param(Integrating(0.1, 1.0, 2.0), LoadRamp(20.0, -6.0, 30.0), marks=pytest.mark.long),
        (Integrating(0.1, 1.0, 2.0), LoadStep(30.0, -5.0)),
    ],
    ids=str,
)
def test_a_stable_process_under_a_load_that_changes_gets_no_gains_for_an_unstable_one(plant, load):
    record = relay_record(plant, load)
    analysis = identified(record)
    assert analysis.identification.structure == "unstable_fopdt", "else this test shows nothing"
    assert (analysis.gains, analysis.verdict.code) == (None, "record_unexplained")
    assert "whose load changes" in analysis.verdict.remedy
    assert identify(record).is_a_guess
    assert any("whose load changes" in text for text in analysis.identification.warnings)


@pytest.mark.long  # tests/core/test_first_try tunes one
@pytest.mark.parametrize(
    "plant",
    [UnstableFopdt(1.0, 20.0, 4.0), pytest.param(UnstableFopdt(2.0, 50.0, 4.0), marks=pytest.mark.long)],
    ids=str,
)
def test_an_unstable_process_gets_its_gains(plant):
    analysis = identified(relay_record(plant))
    assert analysis.verdict.code == "identified"
    assert analysis.gains is not None
    truth = {"K": plant.K, "T": plant.T, "D": plant.D}
    assert analysis.identification.model.parameters() == pytest.approx(truth, rel=0.05)
    assert not analysis.identification.is_a_guess
