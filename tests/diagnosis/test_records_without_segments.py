"""Effects on plain records of output and PV, as a historian keeps them.

Every record is integrated here, in small steps of Euler's method, and by nothing of the product or its simulator.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from benchmarks.accuracy.diagnosis.independent import Case, record_of

pytestmark = pytest.mark.usefixtures("without_gains")

PARTS = 40
"""Steps of Euler's method in a sample interval."""
K, T1, T2, DELAY = 2.0, 10.0, 4.0, 3.0


def levels(rng, n, shortest, longest, swing=10.0):
    """Return an output that rests at 40 and then moves to random levels and back."""
    result = [40.0] * 20
    way = 1.0
    while len(result) < n:
        way = -way
        result += [40.0 + way * rng.uniform(0.3, 1.0) * swing] * int(rng.integers(shortest, longest))
    return np.array(result[:n])


def integrated(output, position, load=lambda _t: 0.0, lags=(T1, T2), gain=K):
    """Return the PV of lags in a row behind a dead time, at the samples.

    Parameters
    ----------
    output : array
        The output at each second.
    position : callable
        From the output and the time to where the actuator is; called at each small step.
    load : callable
        What is added at the input of the process, by time.
    """
    h = 1.0 / PARTS
    x, pv, entered = [0.0] * len(lags), [], [0.0] * int(DELAY / h)
    for k, u in enumerate(output.tolist()):
        pv.append(60.0 + x[-1])
        for j in range(PARTS):
            t = k + j * h
            entered.append(position(u, t) - 40.0)
            source = gain * (entered[-1 - int(DELAY / h)] + load(t))
            for i, lag in enumerate(lags):
                source, x[i] = x[i], x[i] + h / lag * (source - x[i])
    return np.array(pv)


def straight(u, _t):
    return u


def recorded(output, pv, sigma=0.05, seed=1):
    noise = np.random.default_rng(seed).normal(0.0, sigma, pv.size)
    return Recording(np.arange(output.size, dtype=float), output, pv + noise)


class Updated:
    """An actuator that takes over its output at some moments only."""

    def __init__(self, moments):
        self.moments, self.at = list(moments), 40.0

    def __call__(self, u, t):
        while self.moments and self.moments[0] <= t:
            self.moments.pop(0)
            self.at = u
        return self.at


@pytest.mark.long  # what updates are taken over, and when they came, is in test_actuator_effects and test_late_moves
@pytest.mark.parametrize("seed", [3, 4])
def test_an_actuator_that_is_updated_at_uneven_times_is_named(seed):
    rng = np.random.default_rng(seed)
    output = levels(rng, 700, 15, 45)
    moments = np.cumsum(rng.uniform(2.0, 12.0, 300))
    answer = diagnose(recorded(output, integrated(output, Updated(moments))))
    assert [e.name for e in answer.effects] == ["actuator_hold"]
    assert answer.error["fitted"].after < 1.3 * 0.05 < answer.error["fitted"].before / 4.0


@pytest.mark.long  # the next one shows a jump
def test_a_jump_of_the_reading_after_the_fitted_part_is_named():
    output = np.repeat([40.0, 50.0, 36.0], [30, 100, 120])
    pv = integrated(output, straight)
    pv[165:] -= 3.0
    answer = diagnose(recorded(output, pv))
    assert [e.name for e in answer.effects] == ["bias_step"]
    assert answer.effects[0].parameters["size"] == pytest.approx(-3.0, abs=0.2)
    assert answer.error["held_out"].after < 1.4 * 0.05


def relay_with_a_bad_reading(until=700):
    """Return output and reading of a relay that reads 3 too little from 200 s to 400 s."""
    h, x = 1.0 / PARTS, [0.0, 0.0]
    entered, output, pv, up = [0.0] * int(DELAY / h), [], [], True
    noise = np.random.default_rng(2).normal(0.0, 0.05, until)
    for k in range(until):
        reading = x[1] + noise[k] - (3.0 if 200 <= k < 400 else 0.0)
        up = reading < 0.3 if up else reading < -0.3
        u = 0.0 if k < 20 else 6.0 if up else -4.0
        output.append(40.0 + u)
        pv.append(60.0 + reading)
        for _ in range(PARTS):
            entered.append(u)
            x[0] += h / T1 * (K * entered[-1 - int(DELAY / h)] - x[0])
            x[1] += h / T2 * (x[0] - x[1])
    return np.array(output), np.array(pv)


def test_a_reading_that_jumps_there_and_back_under_a_relay_is_named(among):
    among("bias_step", "load_step", "drift")
    output, pv = relay_with_a_bad_reading()
    answer = diagnose(Recording(np.arange(output.size, dtype=float), output, pv))
    assert [(e.name, e.form) for e in answer.effects] == [("bias_step", "there and back")]
    assert answer.effects[0].parameters["size"] == pytest.approx(-3.0, abs=0.2)


def test_a_wave_that_one_process_has_taken_up_is_named(among):
    """Its period is a few of the lags, and its size a good part of what the steps make."""
    among("periodic_disturbance", "ambient", "load_step")
    output = levels(np.random.default_rng(6), 600, 15, 60)
    t = np.arange(output.size)
    answer = diagnose(recorded(output, integrated(output, straight) + 6.0 * np.sin(2.0 * np.pi * t / 31.0 + 1.0)))
    assert [e.name for e in answer.effects] == ["periodic_disturbance"]
    assert answer.effects[0].parameters["period_s"] == pytest.approx(31.0, rel=0.01)
    assert answer.effects[0].parameters["amplitude"] == pytest.approx(6.0, rel=0.05)


def test_a_sawtooth_is_named(among):
    among("periodic_disturbance", "ambient", "load_step")
    output = levels(np.random.default_rng(8), 600, 15, 60)
    t = np.arange(output.size)
    answer = diagnose(recorded(output, integrated(output, straight) + 5.0 * ((t / 41.3 + 0.37) % 1.0)))
    assert [(e.name, e.form) for e in answer.effects] == [("periodic_disturbance", "sawtooth")]
    assert answer.verdict == "explained"
    assert answer.effects[0].parameters["period_s"] == pytest.approx(41.3, rel=1e-3)
    assert answer.effects[0].parameters["amplitude"] == pytest.approx(2.5, rel=0.01)


@pytest.mark.long  # the wave above shows the search
def test_a_wave_that_begins_within_the_record_is_named(among):
    among("periodic_disturbance", "ambient", "load_step")
    output = levels(np.random.default_rng(7), 600, 15, 60)
    t = np.arange(output.size)
    wave = np.where(t >= 230, 3.0 * np.sin(2.0 * np.pi * (t - 230) / 37.0), 0.0)
    answer = diagnose(recorded(output, integrated(output, straight) + wave))
    assert [(e.name, e.form) for e in answer.effects] == [("periodic_disturbance", "begins")]
    assert answer.effects[0].parameters["from_s"] == pytest.approx(230.0, abs=10.0)


@pytest.mark.long
def test_a_limit_and_a_drift_are_both_named():
    """A load of free shape follows the two closely: of the single effects it is the best, and it hides the limit."""
    hidden = record_of(Case("saturation:hard + drift:straight", 593, "steps"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert answer.verdict == "explained"
    assert {e.name for e in answer.effects} == {"saturation", "drift"}
    assert answer.error["held_out"].after < 1.3 * hidden.sigma < answer.error["held_out"].before / 20.0


@pytest.mark.long  # rates by hand are in test_actuator_effects
def test_unequal_rates_of_an_actuator_are_found(among):
    among("rate_limit", "direction_dynamics", "backlash", "direction_gain")
    at = {"x": 40.0}

    def limited(u, _t):
        at["x"] += float(np.clip(u - at["x"], -0.9 / PARTS, 0.4 / PARTS))
        return at["x"]

    output = levels(np.random.default_rng(8), 600, 20, 60)
    answer = diagnose(recorded(output, integrated(output, limited)))
    assert [(e.name, e.form) for e in answer.effects] == [("rate_limit", "unequal")]
    sizes = answer.effects[0].parameters
    assert sizes["rate_per_s"] == pytest.approx(0.4, rel=0.1)
    assert sizes["falling_rate_per_s"] == pytest.approx(0.9, rel=0.1)


@pytest.mark.long  # levels of a curve are in test_free_forms
def test_a_gain_that_changes_at_another_level_than_the_first_is_found(among):
    """Below 43 the actuator has its gain, above it a third of it."""
    among("direction_gain", "static_nonlinearity", "saturation", "backlash")
    output = levels(np.random.default_rng(9), 600, 20, 60)
    answer = diagnose(recorded(output, integrated(output, lambda u, _t: min(u, 43.0) + max(u - 43.0, 0.0) / 3.0)))
    assert [(e.name, e.form) for e in answer.effects] == [("direction_gain", "kink elsewhere")]
    assert answer.effects[0].parameters["ratio"] == pytest.approx(1.0 / 3.0, abs=0.05)
    assert answer.effects[0].parameters["kink"] == pytest.approx(43.0, abs=0.3)
