"""Recordings with a hidden effect, made by the simulator and the tuning's own experiment. A small seeded set."""

from __future__ import annotations

import numpy as np

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Recording, Sample
from autotuner_sim import Fopdt, SopdtOverdamped, SopdtUnderdamped, SteppedPlant

PLANTS = {
    "lag": Fopdt(2.0, 40.0, 4.0),
    "balanced": Fopdt(1.2, 10.0, 6.0),
    "delay": Fopdt(0.8, 5.0, 12.0),
    "second": SopdtOverdamped(1.5, 20.0, 8.0, 5.0),
    "under": SopdtUnderdamped(1.0, 60.0, 8.0, 3.0),
}
SAMPLE_S = {"lag": 0.25, "balanced": 0.25, "delay": 0.3, "second": 0.4, "under": 0.25}
AMPLITUDE = 10.0


def tuning_record(plant, sample_s=0.25, sigma=0.0, seed=0, amplitude=AMPLITUDE, *, output0=40.0, noise=None, **physics):
    """Run the tuning's experiment on a plant with hidden physics and return its recording."""
    stepped = SteppedPlant(plant, output0=output0, pv0=100.0, **physics)
    settings = ExperimentSettings(
        sample_time_s=sample_s, limits=Limits((0.0, 100.0)), amplitude=amplitude, hysteresis=max(3.0 * sigma, 0.02)
    )
    experiment = Experiment(settings, output0)
    random = np.random.default_rng(seed)
    samples, t = [], 0.0
    for _ in range(20_000):
        stepped.advance(t)
        pv = stepped.measure() + (sigma * random.standard_normal() if noise is None else noise(random))
        command = experiment.step(Sample(t, pv, stepped.output))
        stepped.output = command.output
        samples.append(Sample(t, pv, stepped.output))
        if experiment.phase in {Phase.RESTORE, Phase.ENDED}:
            break
        t += sample_s
    assert experiment.verdict is None, experiment.verdict
    return Recording.from_samples(samples, experiment.settings_so_far())


def swing_of_pv(plant, sample_s=0.25, amplitude=AMPLITUDE):
    """Return the standard deviation of the PV in a clean record: what the noise is measured against."""
    return float(np.std(tuning_record(plant, sample_s, amplitude=amplitude).pv))
