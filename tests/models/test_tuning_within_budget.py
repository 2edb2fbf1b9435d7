"""A tuning on a controller without the time for least squares: gains that are robust on the true process."""

import json

import pytest

import autotuner
from autotuner.cli import main
from autotuner.core.design import DesignSpec
from autotuner.core.design.loop_margins import margins
from autotuner.core.design.pid_design import judged_process
from autotuner.core.model.process import model_from_dict
from autotuner.errors import InputError
from tests.service.conftest import HEATER, configure, serving

__all__ = ["configure", "serving"]

SAMPLE_TIME_S = 0.1
NO_TIME_MS, PLENTY_MS = 1e-3, 600_000.0
OFF_THE_GRID = {
    "dead time small": ({"structure": "fopdt", "K": 0.71, "T": 29.06, "D": 3.79}, False),
    "gain from the check": ({"structure": "fopdt", "K": 1.37, "T": 23.0, "D": 2.9}, True),
    "dead time large": ({"structure": "fopdt", "K": 3.1, "T": 4.3, "D": 9.7}, False),
    "two lags": ({"structure": "sopdt_overdamped", "K": 1.9, "T1": 11.3, "T2": 4.7, "D": 2.1}, True),
    "integrating": ({"structure": "integrating", "K": 0.07, "T": 3.0, "D": 2.3}, False),
    "two near lags": ({"structure": "sopdt_overdamped", "K": 1.07, "T1": 18.67, "T2": 13.76, "D": 2.97}, False),
}


def tuned(plant, *, check=False, budget_ms=NO_TIME_MS, **how):
    device = {"plant": plant, "output0": 40.0, "pv0": 80.0, "noise": 0.05, "seed": 7}
    relay = {"amplitude": 10.0, "check": check}
    return autotuner.run(simulated=device, sample_time_s=SAMPLE_TIME_S, relay=relay, budget_ms=budget_ms, **how)


USUAL = ("dead time small", "gain from the check", "two lags")


@pytest.mark.one_of(2)
@pytest.mark.parametrize(
    ("plant", "check"),
    [
        pytest.param(*case, id=name, marks=[] if name in USUAL else [pytest.mark.long])
        for name, case in OFF_THE_GRID.items()
    ],
)
def test_early_gains_are_robust_on_the_true_process(plant, check):
    result = tuned(plant, check=check)
    assert result.done
    assert result.identification.recommended == "learned"
    found = margins(judged_process(model_from_dict(plant), SAMPLE_TIME_S)[0], result.gains)
    assert found.stable
    assert found.Ms <= 1.6


def test_the_verdict_and_the_notes_say_what_they_are_and_what_to_do():
    result = tuned(OFF_THE_GRID["dead time small"][0])
    assert "did not suffice for least squares" in result.verdict.message
    assert "give more time" in result.verdict.remedy
    notes = result.to_dict()["notes"]
    assert any("calibrated errors" in note for note in notes)
    assert any(note.startswith("early gains: simc_pi") for note in notes)
    errors = result.identification.estimates["learned"].standard_error
    assert set(errors) == {"K", "T", "D"}
    assert all(error > 0.0 for error in errors.values())


@pytest.mark.long  # early gains, above, are of the same search
@pytest.mark.usefixtures("without_diagnosis")
def test_with_time_the_result_is_that_without_a_budget():
    plant = OFF_THE_GRID["dead time small"][0]
    how = {"goal": DesignSpec(rule="simc_pi"), "structure": "fopdt"}
    with_time, free = tuned(plant, budget_ms=PLENTY_MS, **how), tuned(plant, budget_ms=None, **how)
    assert with_time.identification.recommended == "least_squares"
    assert with_time.gains == free.gains
    assert with_time.to_dict()["notes"] == free.to_dict()["notes"]


def test_a_learned_model_that_does_not_explain_the_record_has_no_gains():
    """Here the wave ends before the transient does: that is said, with what helps."""
    result = tuned({"structure": "sopdt_underdamped", "K": 1.5, "m": 31.0, "n": 4.9, "D": 2.3})
    assert result.gains is None
    assert result.verdict.code == "budget_spent"
    assert "give more time" in result.verdict.remedy


def test_beside_a_controller_there_is_no_learned_answer():
    """The correction was trained on the relay alone."""
    device = {"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}, "output0": 40.0, "pv0": 80.0}
    relay = {"amplitude": 10.0, "check": False, "online": {"Kp": 0.5, "Ti": 10.0}}
    result = autotuner.run(simulated=device, sample_time_s=SAMPLE_TIME_S, relay=relay, budget_ms=NO_TIME_MS)
    assert result.verdict.code == "budget_spent"
    assert "a controller ran in parallel with the relay" in result.verdict.message


@pytest.mark.parametrize("budget_ms", [0, -1, float("nan"), float("inf"), "20", True])
def test_a_budget_that_is_none_is_refused_before_anything_moves(budget_ms):
    with pytest.raises(InputError) as refused:
        autotuner.run(simulated={}, budget_ms=budget_ms)
    assert refused.value.field == "budget_ms"
    assert refused.value.value is budget_ms
    assert "leave it out" in refused.value.remedy


def test_the_command_tunes_within_a_budget(capsys):
    assert main(["tune", "--no-check", "--budget-ms", str(NO_TIME_MS), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["recommended"] == "learned"
    assert told["tuning"]["rule"].startswith("simc")


@pytest.mark.parametrize("text", ["0", "-5", "soon"])
def test_the_command_refuses_another_budget(text, capsys):
    assert main(["tune", "--budget-ms", text]) == 2
    assert "--budget-ms" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_over_http_a_budget_is_kept_and_bad_ones_are_refused(serving, configure):
    async with serving(configure({"heater": HEATER})) as service:
        for bad in (0, -1, "20"):
            refused = await service.client.post("/v1/loops/heater/tunings", json={"budget_ms": bad})
            assert refused.status_code == 422
            assert "budget_ms" in refused.text
        started = await service.client.post("/v1/loops/heater/tunings", json={"budget_ms": NO_TIME_MS, "check": False})
        await service.client.get(started.json()["links"]["events"])
        result = (await service.client.get(started.json()["links"]["self"])).json()
    assert result["verdict"]["outcome"] == "done"
    assert "give more time" in result["verdict"]["remedy"]
    assert result["recommended"] == "learned"
    assert result["gains"]["Kp"] == result["tuning"]["gains"]["Kp"]
