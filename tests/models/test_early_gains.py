"""Gains before there is time for least squares: within a budget, and while the relay still runs."""

import argparse
import itertools
import json

import pytest

from autotuner.application.analysis.early_gains import cautious, with_gains
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.commands.identify import command as identify_command
from autotuner.control.reporting.events import ModelUpdated
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.identification import RunningModel, identify_within
from autotuner.core.model.process import Fopdt, NLags, SopdtOverdamped
from autotuner_models.learned.artefacts import SHIPPED, load
from autotuner_sim import Fopdt as SimulatedFopdt

PLANT = SimulatedFopdt(2.0, 10.0, 3.0)


@pytest.fixture(scope="module")
def models():
    return load(SHIPPED)


def spent_after(count):
    """A clock that is spent when it has been asked so often."""
    asked = itertools.count()
    return lambda: next(asked) >= count


def test_without_time_the_learned_model_is_the_recommended_one(models, record):
    found = identify_within(record(PLANT, decibels=30.0), spent_after(0), known_gain=2.0, learned=models)
    assert found.recommended == "learned"
    assert pytest.approx(10.0, rel=0.03) == found.model.T
    assert found.estimates["learned"].covariance.shape == (3, 3)
    assert any("least squares" in note for note in found.warnings)


def test_a_budget_that_ends_in_the_middle_of_the_search_has_the_same_answer(models, record):
    one = record(PLANT, decibels=30.0)
    at_once, later = (identify_within(one, spent_after(n), known_gain=2.0, learned=models) for n in (0, 20))
    assert later.recommended == "learned"
    assert later.model == at_once.model


def test_with_time_least_squares_is(models, record):
    found = identify_within(record(PLANT, decibels=30.0), lambda: False, known_gain=2.0, learned=models)
    assert found.recommended == "least_squares"


def test_without_time_and_without_trained_files_there_is_no_model(record):
    """The ablation: with the trained files a user has a model and gains, without them neither."""
    found = identify_within(record(PLANT), spent_after(0), known_gain=2.0, learned="removed")
    assert found.model is None
    assert found.verdict.code == "budget_spent"


def test_gains_are_those_of_the_rule_at_the_cautious_end_by_hand():
    running = RunningModel(Fopdt(2.0, 10.0, 3.0), {"K": 0.1, "T": 0.5, "D": 0.2}, 0.05, "learned")
    K, T, D = 2.0 + 1.96 * 0.1, 10.0 - 1.96 * 0.5, 3.0 + 1.96 * 0.2 + 0.1 / 2.0
    gains = with_gains(running, 0.1).gains
    assert gains["Kp"] == pytest.approx(T / (K * 2.0 * D), rel=1e-5)
    assert gains["Ti"] == pytest.approx(min(T, 8.0 * D), rel=1e-5)


def test_a_gain_keeps_its_sign_and_lags_their_order():
    model = SopdtOverdamped(-2.0, 10.0, 9.0, 1.0)
    found = cautious(RunningModel(model, {"K": 0.1, "T1": 3.0, "T2": 0.1, "D": 0.0}, 0.1))
    assert pytest.approx(-2.0 - 1.96 * 0.1, rel=1e-6) == found.K
    assert found.T1 >= found.T2


@pytest.mark.parametrize(
    "running",
    [
        RunningModel(Fopdt(2.0, 10.0, 3.0), {}, 0.4, "learned"),
        RunningModel(Fopdt(2.0, 10.0, 3.0), {}, 0.01, "learned", explains=False),
        RunningModel(NLags(2.0, 10.0, 3.0, 1.0), {}, 0.01),
        None,
    ],
    ids=["too vague", "explains too little", "no rule of its own", "no model"],
)
def test_there_are_none_for_a_model_that_is_no_ground_for_them(running):
    found = with_gains(running, 0.1)
    assert found is None or found.gains is None


def test_the_command_has_gains_within_its_budget(record, tmp_path, capsys):
    file = tmp_path / "relay.csv"
    file.write_text(record(PLANT, decibels=30.0).to_csv())
    parser = argparse.ArgumentParser()
    identify_command.configure(parser)
    words = [str(file), "--budget-ms", "0.001", "--known-gain", "2", "--json"]
    assert identify_command.run(parser.parse_args(words)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["recommended"] == "learned"
    assert told["gains"]["rule"] == "simc_pi"
    # SIMC for the true process: T/(2 K D) and min(T, 8 D).
    assert told["gains"]["Kp"] == pytest.approx(10.0 / (2.0 * 2.0 * 3.0), rel=0.1)
    assert told["gains"]["Ti"] == pytest.approx(10.0, rel=0.1)


def test_a_running_tuning_offers_the_latest_until_there_are_those_of_the_record():
    tuning = TuningRun("T1", "TIC-101", TuningRequest(ExperimentSettings()))
    assert tuning.to_dict()["early_gains"] is None
    for t, method, gains in ((20.0, "learned", {"Kp": 1.0, "rule": "simc_pi"}), (21.0, "least_squares", None)):
        tuning.publish(ModelUpdated(t, "fopdt", {"K": 2.0}, {"K": 0.1}, 0.05, method, gains))
    offered = tuning.to_dict()["early_gains"]
    assert (offered["method"], offered["t"], offered["Kp"]) == ("learned", 20.0, 1.0)
