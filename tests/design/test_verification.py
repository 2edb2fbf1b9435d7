"""The judge of a verification step: right models pass, wrong ones go back before the PV has gone far."""

import functools
import math

import numpy as np
import pytest

from autotuner.core.design import design
from autotuner.core.design.simulation.closed_loop import Scenario, predict
from autotuner.core.design.simulation.pid import PidSettings
from autotuner.core.design.simulation.verification import Decision, Verification, predicted_band
from autotuner.core.model.process import Fopdt, SopdtOverdamped

STEP = 1.0
NOISE = 0.01
designed = functools.cache(design)
"""The same gains, computed once: several tests judge them."""


def plants(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        K, T, D = rng.uniform(0.5, 3.0), rng.uniform(3.0, 20.0), rng.uniform(0.5, 8.0)
        yield SopdtOverdamped(K, T, T * rng.uniform(0.05, 0.9), D) if rng.random() < 0.5 else Fopdt(K, T, D)


def some(count, seed, usual):
    """Return numbered plants, of which all but the first `usual` are for `run.py long`."""
    return [
        pytest.param(k, plant, marks=[pytest.mark.long] if k >= usual else [])
        for k, plant in enumerate(plants(count, seed))
    ]


def verified(model, truth, seed, actuator=None, missing=0.0):
    """Return the decision and the largest PV met before it, for gains of `model` on the process `truth`.

    `missing` is the share of the samples, chosen at random, that never come.
    """
    lost = np.random.default_rng(seed + 100).random(402) < missing
    settings = PidSettings(designed(model).gains)
    span = 8.0 * (truth.D + sum(truth.parameters().get(name, 0.0) for name in ("T", "T1", "T2")))
    scenario = Scenario(span, span / 400.0, set_point_step=STEP, load_step=STEP / truth.K)
    judge = Verification(predicted_band(model, settings, scenario, noise_sigma=NOISE))
    noise = NOISE * np.random.default_rng(seed).standard_normal(402)
    seen = predict(truth, settings, scenario, actuator=actuator, noise=noise)
    for k, (t, pv, output) in enumerate(zip(seen.t, seen.pv, seen.output, strict=True)):
        if lost[k] and k < seen.t.size - 1:
            continue
        decision = judge.step(float(t), float(pv), float(output))
        if decision is not Decision.GO_ON:
            return decision, float(np.max(np.abs(seen.pv[: k + 1]))), judge.evidence
    raise AssertionError("the judge did not end")


def scaled(model, **factors):
    values = model.parameters()
    return type(model)(**{name: value * factors.get(name, 1.0) for name, value in values.items()})


class Stiction:
    """A valve that stays until the command is `band` away, then jumps to it."""

    def __init__(self, band):
        self.band, self.position = band, 0.0

    def __call__(self, command):
        if abs(command - self.position) > self.band:
            self.position = command
        return self.position


@pytest.mark.parametrize(("seed", "truth"), some(15, 2, 7))
def test_a_right_model_passes(seed, truth):
    decision, _, evidence = verified(truth, truth, seed)
    assert decision is Decision.PASS, evidence


@pytest.mark.parametrize(("seed", "truth"), some(15, 2, 7))
def test_a_right_model_passes_on_a_line_that_loses_samples(seed, truth):
    decision, _, evidence = verified(truth, truth, seed, missing=0.4)
    assert decision is Decision.PASS, evidence


@pytest.mark.one_of(3)
@pytest.mark.parametrize("factors", [{"K": 0.5}, {"K": 2.0}, {"D": 0.5}], ids=str)
@pytest.mark.parametrize(("seed", "truth"), list(enumerate(plants(6, 4))))
def test_a_wrong_model_goes_back_in_time(seed, truth, factors):
    decision, largest, evidence = verified(scaled(truth, **factors), truth, seed)
    assert decision is Decision.ROLL_BACK
    assert largest < 2.0 * STEP
    assert "left the predicted band" in evidence


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("seed", "truth"), list(enumerate(plants(6, 3))))
def test_a_hidden_sticking_valve_goes_back(seed, truth):
    band = 0.8 * STEP / truth.K
    decision, largest, _ = verified(truth, truth, seed, Stiction(band))
    assert decision is Decision.ROLL_BACK
    assert largest < 2.0 * STEP


def test_a_lost_pv_goes_back_and_a_single_lost_one_does_not():
    model = Fopdt(2.0, 10.0, 2.0)
    judge = Verification(predicted_band(model, PidSettings(designed(model).gains), Scenario(60.0, 0.5, STEP)))
    first = float(judge.band.output.high[0] + judge.band.output.low[0]) / 2.0
    assert judge.step(0.0, 0.0, first) is Decision.GO_ON
    decisions = [judge.step(t, math.nan, first) for t in (0.5, 1.0, 1.5)]
    assert decisions == [Decision.GO_ON, Decision.GO_ON, Decision.ROLL_BACK]
    assert "was lost 1.5 s" in judge.evidence


def test_a_single_sample_outside_is_no_evidence():
    model = Fopdt(2.0, 10.0, 2.0)
    settings, scenario = PidSettings(designed(model).gains), Scenario(60.0, 0.5, STEP)
    judge, seen = Verification(predicted_band(model, settings, scenario)), predict(model, settings, scenario)
    decisions = [
        judge.step(float(t), float(pv) + (5.0 if k == 40 else 0.0), float(output))
        for k, (t, pv, output) in enumerate(zip(seen.t, seen.pv, seen.output, strict=True))
    ]
    assert decisions[-1] is Decision.PASS
    assert set(decisions[:-1]) == {Decision.GO_ON}
    assert "the PV left the predicted band by" in judge.evidence


def test_an_uncertain_model_has_a_wider_band():
    model = Fopdt(2.0, 10.0, 2.0)
    settings, scenario = PidSettings(designed(model).gains), Scenario(60.0, 0.5, STEP)
    sharp = predicted_band(model, settings, scenario)
    wide = predicted_band(model, settings, scenario, covariance=np.diag([0.2, 1.0, 0.2]) ** 2)
    assert np.all(wide.pv.high >= sharp.pv.high)
    assert np.all(wide.pv.low <= sharp.pv.low)
    assert np.max(wide.pv.high - wide.pv.low) > 1.5 * np.max(sharp.pv.high - sharp.pv.low)
