"""An integrating process is brought back to where it was found before its output is given back."""

from types import SimpleNamespace

import pytest

from autotuner.application.computing.estimator import as_integrator
from autotuner.core.design import PidGains
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase, PhaseEvent
from autotuner.core.experiment.relay import Relay
from autotuner.core.experiment.relay_phase.check import Oscillated, Return
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, UnstableFopdt
from autotuner.core.recording import Sample
from autotuner_sim import Integrating as IntegratingPlant
from autotuner_sim import LoadStep, Noise, SteppedPlant

K, T, D = 0.02, 5.0, 15.0
PLANT, MODEL = IntegratingPlant(K, T, D), Integrating(K, T, D)
SAMPLE_S, OUTPUT0, PV0 = 1.0, 40.0, 50.0
SETTLED_S = D + 10.0 * T


def left_after(informed, loads=(), sigma=0.0, online=None):
    """Return how far from its start the simulated PV of an integrator comes to rest, and its largest way from there."""
    settings = ExperimentSettings(sample_time_s=SAMPLE_S, hysteresis=0.5, online=online)
    noise = [Noise(sigma, seed=7)] if sigma else []
    loop = SteppedPlant(PLANT, output0=OUTPUT0, pv0=PV0, loads=loads, sensors=noise)
    experiment, farthest = Experiment(settings, OUTPUT0), 0.0
    for k in range(20_000):
        t = k * SAMPLE_S
        loop.advance(t)
        farthest = max(farthest, abs(loop.pv - PV0))
        experiment.inform(0.5, integrating=informed)
        command = experiment.step(Sample(t, loop.measure(), loop.output))
        loop.output = command.output
        if command.phase is Phase.RESTORE:
            assert experiment.verdict is None
            loop.advance(t + SETTLED_S)
            return loop.pv - PV0, farthest
    raise AssertionError("the experiment did not end")


LEVEL = 2 * K * 13.4 * SAMPLE_S
"""Two samples at the far level of the relay, PV units: 2 % of the way that the test moves the PV."""


def test_an_integrating_process_is_left_where_it_was_found():
    away, farthest = left_after(None)
    back, farthest_with_return = left_after(MODEL)
    assert abs(back) < LEVEL < 0.2 * abs(away)
    assert farthest_with_return == pytest.approx(farthest, rel=0.5)


@pytest.mark.parametrize("running", [Integrating(0.85 * K, T, D), Integrating(1.15 * K, T, D), Integrating(K, 0.0, D)])
def test_without_a_load_an_error_of_the_running_model_does_not_matter(running):
    assert abs(left_after(running)[0]) < LEVEL


@pytest.mark.parametrize("load", [-2.0, 2.0])
def test_what_a_load_moved_during_the_test_is_removed_too(load):
    """The load of 100 s moves the PV by `100 K load`, which the output alone does not show."""
    passing = [LoadStep(300.0, load), LoadStep(400.0, -load)]
    assert abs(left_after(MODEL, passing, sigma=0.05)[0]) < 2 * LEVEL < 0.5 * 100.0 * K * abs(load)


def test_a_process_tuned_beside_a_controller_is_brought_back():
    assert abs(left_after(MODEL, online=PidGains(0.5, 200.0, 0.0))[0]) < LEVEL


@pytest.mark.parametrize(
    ("pv", "ended"),
    [(59.5, False), (66.0, False), (69.0, True), (45.0, False), (41.0, True)],
    ids=["as far as at its start", "farther, for a dead time", "running away", "on the other side", "far over there"],
)
def test_a_pv_that_is_far_when_the_return_begins_does_not_end_it(pv, ended):
    """The check was cut short because the PV had gone four amplitudes of 2: that is what the return is for."""
    cycle = SimpleNamespace(period_s=10.0, peak=2.0, duty=0.5)
    found = Oscillated(Relay(30.0, 50.0, 50.0, 0.5, direct=True), cycle)
    back = Return(found, lambda: 100.0, 40.0, Sample(0.0, 59.5, 45.0), 1.0)
    assert back.output == 30.0
    assert (back.step(Sample(1.0, pv, 30.0)).event is PhaseEvent.CHECKED) == ended


def test_the_last_sample_removes_no_more_than_is_left():
    cycle, left = SimpleNamespace(period_s=10.0, peak=2.0, duty=0.5), [-23.0, -13.0, -3.0, 0.0]
    found = Oscillated(Relay(30.0, 50.0, 50.0, 0.5, direct=True), cycle)
    back = Return(found, lambda: left.pop(0), 40.0, Sample(0.0, 50.0, 40.0), 1.0)
    assert back.output == 50.0
    steps = [back.step(Sample(t, 50.0, 50.0)) for t in (1.0, 2.0, 3.0)]
    assert [step.output for step in steps] == [50.0, 43.0, 43.0]
    assert [step.event for step in steps] == [None, None, PhaseEvent.CHECKED]


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (Integrating(1.0, 2.0, 1.0), Integrating(1.0, 2.0, 1.0)),
        (SopdtOverdamped(3.0, 150.0, 50.0, 1.0), Integrating(0.015, 37.5, 1.0)),
        (Fopdt(1.0, 30.0, 5.0), None),
        (UnstableFopdt(1.0, 500.0, 5.0), None),
    ],
)
def test_a_lag_longer_than_the_record_counts_as_an_integrator(model, expected):
    assert as_integrator(model, 100.0) == expected
