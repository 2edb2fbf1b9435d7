"""Trained files that cannot be used cost the learned estimate and nothing else."""

import shutil

import pytest

from autotuner.application.analysis import learned as registry
from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.reporting.events import ModelUpdated
from autotuner.core.design import DesignSpec
from tests.service.conftest import HEATER

LOOP = HEATER | {"device": HEATER["device"] | {"seed": 3}}


@pytest.fixture(autouse=True)
def fresh():
    """Trained files are looked for anew before and after each test."""
    registry.learned_models.cache_clear()
    yield
    registry.learned_models.cache_clear()


@pytest.fixture
def tuned(virtual):
    """Return a function that tunes a loop in virtual time and returns the tuning."""

    def tune():
        loop = parse_configuration({"loops": {"TIC-101": LOOP}}, "test").loop("TIC-101")
        backend = make_backend("simulated", loop.device, "loops.TIC-101")
        tuning = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings(), spec=DesignSpec(rule="simc_pi")))
        virtual(tuning.conduct(loop, backend, InPlace()))
        return tuning

    return tune


def tampered(folder):
    (folder / "learned.arrays").write_bytes(b"something else")


def missing(folder):
    shutil.rmtree(folder)


def of_another_format(folder):
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"format": 1', '"format": 2'))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (tampered, "vouches for"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in ((missing, "cannot be read"), (of_another_format, "is of format 2"))
        ),
    ],
)
def test_a_loop_is_tuned_without_it_and_the_result_says_why(spoil, said, small, tmp_path, monkeypatch, tuned):
    folder = shutil.copytree(small, tmp_path / "learned")
    spoil(folder)
    monkeypatch.setenv(registry.ARTEFACTS, str(folder))
    analysis = tuned().analysis
    assert analysis.verdict.code == "identified"
    assert analysis.gains is not None
    refusal = analysis.identification.estimates["learned"].refusal
    assert said in refusal
    assert "autotuner train" in refusal


def test_with_it_the_estimate_stands_beside_the_others(tuned):
    learned = tuned().analysis.identification.estimates["learned"]
    assert learned.refusal is None
    assert learned.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.05)
    assert all(low < high for low, high in learned.interval95.values())


def test_while_the_relay_runs_it_is_shown_before_least_squares(tuned):
    """After each half period from which on the static gain is known; here the first least squares tells it."""
    methods = [event.method for event in tuned().events if isinstance(event, ModelUpdated)]
    assert methods[0] == "least_squares"
    assert methods[1:3] == ["learned", "least_squares"]
    assert methods.count("learned") >= 2
