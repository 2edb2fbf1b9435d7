"""Equal lags and third order are chosen where the record shows them, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner.application.analysis.procedure import gains_for
from autotuner.core.identification import identify
from autotuner.core.model.process import Fopdt, NLags, SopdtOverdamped, ThirdOrder, ThirdOrderUnderdamped
from autotuner.core.recording import Recording
from autotuner_sim import RationalPlant, SteppedPlant

LAGS = {
    "3 3 3 3": ((3.0, 3.0, 3.0, 3.0), "n_lags"),
    "5 5 5": ((5.0, 5.0, 5.0), "n_lags"),
    "10 3 1": ((10.0, 3.0, 1.0), "third_order"),
}


def denominator(lags):
    a = np.array([1.0])
    for T in lags:
        a = np.polymul(a, [T, 1.0])
    return tuple(a[::-1].tolist())


def relayed(a, K, D, sigma, dt, switches=9):
    """A relay record from rest, integrated by the simulator, which shares no code with the models."""
    device, rng, rows = SteppedPlant(RationalPlant((K,), a, D)), np.random.default_rng(3), []
    is_high, switched, k = True, -1, 0
    while switched < switches:
        device.advance(k * dt)
        pv = device.pv + sigma * rng.standard_normal()
        was = is_high
        if k > 50 and abs(pv) > 3.0 * sigma:
            is_high = pv < 0.0
        switched += is_high != was
        device.output = 0.0 if k < 50 else 1.5 if is_high else -1.0
        rows.append((k * dt, device.output, pv))
        k += 1
    return Recording(*np.array(rows).T, settings={"noise_sigma": sigma})


@pytest.mark.one_of(2)
@pytest.mark.parametrize("name", LAGS)
def test_the_lags_of_the_record_are_found_without_a_warning(name):
    lags, structure = LAGS[name]
    found = identify(relayed(denominator(lags), 2.0, 1.0, 0.01, 0.25))
    assert found.structure == structure
    assert pytest.approx(2.0, rel=0.03) == found.model.K
    assert not any("lacks" in warning or "not explained" in warning for warning in found.warnings)
    if structure == "n_lags":
        assert found.model.n == len(lags)
        assert pytest.approx(lags[0], rel=0.03) == found.model.T
        assert found.estimates["least_squares"].interval95["n"] == (len(lags), len(lags))


def test_four_lags_without_noise_are_no_pair():
    """No structure is these four lags, so no residual is noise: a pair leaves 1.4 % of the swing, K 14 % off."""
    found = identify(relayed(denominator((8.0, 6.4, 5.12, 4.1)), 2.0, 0.0, 0.0, 0.25))
    assert isinstance(found.model, ThirdOrder | ThirdOrderUnderdamped)
    assert pytest.approx(2.0, rel=0.02) == found.model.K


def test_a_pair_and_a_lag_are_third_order_too():
    found = identify(relayed((1.0, 7.0, 22.0, 36.0), 2.0, 2.0, 0.002, 0.25))
    # (9 s^2 + 3 s + 1)(4 s + 1)
    assert isinstance(found.model, ThirdOrderUnderdamped)
    assert pytest.approx(4.0, rel=0.1) == found.model.T
    assert found.model.m == pytest.approx(9.0, rel=0.1)


@pytest.mark.parametrize(("a", "kind"), [((1.0, 10.0), Fopdt), (denominator((10.0, 4.0)), SopdtOverdamped)])
def test_a_process_of_lower_order_stays_one(a, kind):
    assert isinstance(identify(relayed(a, 2.0, 2.0, 0.01, 0.1)).model, kind)


def test_a_structure_asked_for_is_what_is_fitted():
    record = relayed(denominator((3.0, 3.0, 3.0)), 2.0, 1.0, 0.005, 0.15)
    assert isinstance(identify(record, structure="n_lags").model, NLags)
    assert isinstance(identify(record, structure="third_order").model, ThirdOrder | ThirdOrderUnderdamped)


@pytest.mark.long  # close lags are in test_least_squares
def test_lags_that_are_nearly_equal_have_bounded_errors_and_gains_near_those_of_the_true_process():
    lags = (12.0, 11.0, 9.0)
    found = identify(relayed(denominator(lags), 2.0, 2.0, 0.01, 0.5), structure="third_order")
    estimate = found.estimates["least_squares"]
    assert estimate.pair_covariance.shape == (5, 5)
    assert all(high <= 1.3 * sum(lags) for name, (_, high) in estimate.interval95.items() if name.startswith("T"))
    gains = gains_for(found).gains
    expected = gains_for(replace(found, model=ThirdOrder(2.0, *lags, 2.0), estimates={}, recommended=None)).gains
    assert gains.Kp == pytest.approx(expected.Kp, rel=0.1)
    assert gains.Ti == pytest.approx(expected.Ti, rel=0.15)
