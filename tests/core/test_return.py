"""An integrating process is brought back to where it was found before its output is given back."""

from types import SimpleNamespace

import pytest

from autotuner.application.computing.estimator import _integrates
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase, PhaseEvent
from autotuner.core.experiment.relay import Relay
from autotuner.core.experiment.relay_phase.check import Oscillated, Return
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, UnstableFopdt
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


@pytest.mark.parametrize(
    ("pv", "ended"),
    [(59.5, False), (66.0, False), (69.0, True), (45.0, False), (41.0, True)],
    ids=["as far as at its start", "farther, for a dead time", "running away", "on the other side", "far over there"],
)
def test_a_pv_that_is_far_when_the_return_begins_does_not_end_it(pv, ended):
    """The check was cut short because the PV had gone four amplitudes of 2: that is what the return is for."""
    cycle = SimpleNamespace(period_s=10.0, peak=2.0, duty=0.5)
    found = Oscillated(Relay(30.0, 50.0, 50.0, 0.5, direct=True), cycle)
    back = Return(found, 100.0, 40.0, Sample(0.0, 59.5, 45.0))
    assert back.output == 30.0
    assert (back.step(Sample(1.0, pv, 30.0)).event is PhaseEvent.CHECKED) == ended


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (Integrating(1.0, 2.0, 1.0), True),
        (SopdtOverdamped(2e5, 1e5, 1.0, 1.0), True),
        (Fopdt(1.0, 30.0, 5.0), False),
        (UnstableFopdt(1.0, 500.0, 5.0), False),
    ],
)
def test_a_lag_longer_than_the_record_counts_as_an_integrator(model, expected):
    assert _integrates(model, 100.0) == expected
