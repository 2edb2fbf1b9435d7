"""An integrating process is brought back to where it was found before its output is given back."""

import pytest

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.recording import Sample

GAIN, DELAY = 0.02, 15
"""PV per output and sample, and dead time in samples."""


def left_after(*, integrates):
    """Return how far from 50 the PV of an integrator is when it is left, and its largest way from there."""
    settings = ExperimentSettings(sample_time_s=1.0, hysteresis=0.5)
    experiment = Experiment(settings, 40.0)
    pv, output, waiting, farthest = 50.0, 40.0, [40.0] * DELAY, 0.0
    for k in range(20_000):
        experiment.inform(0.5, integrates=integrates)
        output = experiment.step(Sample(float(k), pv, output)).output
        if experiment.phase is Phase.RESTORE:
            break
        waiting.append(output)
        pv += GAIN * (waiting.pop(0) - 40.0)
        farthest = max(farthest, abs(pv - 50.0))
    on_its_way = sum(GAIN * (u - 40.0) for u in waiting)
    assert experiment.verdict is None
    return pv + on_its_way - 50.0, farthest


def test_an_integrating_process_is_left_where_it_was_found():
    away, farthest = left_after(integrates=False)
    back, farthest_with_return = left_after(integrates=True)
    # One sample more or less at the far level is the smallest step there is: 13.3 of output.
    assert abs(back) < 2 * GAIN * 13.4 < 0.2 * abs(away)
    assert farthest_with_return == pytest.approx(farthest, rel=0.5)
