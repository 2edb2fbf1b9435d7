"""A record with further columns that begins cold: the process rests at an output of zero until the first sample."""

import numpy as np
import pytest

from autotuner import Recording, diagnose

pytestmark = pytest.mark.usefixtures("without_gains")

N, H = 260, 3.0
K, T, SENSOR, OTHER, SLOW = 0.6, 150.0, 12.0, 0.2, 180.0


def two_heaters(seed=3, sigma=0.05):
    """Heater 1 to temperature 1, which a second heater warms through a body of its own; Euler steps of 0.1 s."""
    random = np.random.default_rng(seed)
    first = np.repeat(random.uniform(0.0, 100.0, N // 20), 20)
    first[:20] = 70.0
    second = np.repeat(np.concatenate((np.zeros(2), random.uniform(0.0, 100.0, N // 20 - 2))), 20)
    body = inside = measured = 0.0
    pv = []
    for q1, q2 in zip(first, second, strict=True):
        pv.append(measured)
        for _ in range(round(H / 0.1)):
            body += 0.1 * (q2 - body) / SLOW
            inside += 0.1 * (K * q1 + OTHER * body - inside) / T
            measured += 0.1 * (inside - measured) / SENSOR
    noise = sigma * random.standard_normal(N)
    return Recording(H * np.arange(N), first, 21.0 + np.array(pv) + noise, extra={"heater_2": second})


@pytest.mark.long  # a column with its own lag, and a motion before the record, are in test_*_effects
def test_a_second_heater_is_taken_in_with_its_own_lag():
    found = diagnose(two_heaters())
    assert [effect.name for effect in found.effects] == ["measured_disturbance"]
    assert found.effects[0].parameters == pytest.approx({"gain": OTHER, "lag_s": SLOW}, rel=0.1)
    assert abs(found.process.K - K) < 0.03 * K
    assert found.error["held_out"].after < 2.0 * 0.05 < found.error["held_out"].before


@pytest.mark.long  # the test above shows a column that is taken in
def test_a_column_that_explains_is_not_given_up_for_a_guess():
    """Beside the heater a jump of the reading: both are named, whichever was found first."""
    record = two_heaters()
    jumped = Recording(record.t, record.output, record.pv + 0.8 * (record.t > 250.0), extra=record.extra)
    found = {effect.name: effect.parameters for effect in diagnose(jumped).effects}
    assert found.keys() == {"measured_disturbance", "bias_step"}
    assert found["bias_step"] == pytest.approx({"at_s": 250.0, "size": 0.8}, rel=0.05)
