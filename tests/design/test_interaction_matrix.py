"""Two loops against the textbook's matrices: Bristol's array, and the inverse of `I + G C` on a dense grid."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autotuner.core.design import PidGains
from autotuner.core.design.interaction import Pair, advice, decoupled, detuned, interaction
from autotuner.core.model.process import Fopdt, Integrating
from autotuner.errors import InputError

W = np.geomspace(1e-4, 50.0, 40_000)
GENTLE = (PidGains(0.3, 12.0), PidGains(0.5, 10.0))


def pair_of(k12=0.8, k21=0.4, gains=GENTLE):
    return Pair(Fopdt(2.0, 10.0, 1.0), Fopdt(1.0, 8.0, 1.5), Fopdt(k12, 15.0, 2.0), Fopdt(k21, 6.0, 0.5), gains)


def matrix_sensitivity(pair, gains=None, decoupler=(0.0, 0.0)):
    """Return `(I + G D C)^-1` on `W`, shape (N, 2, 2), written out from the models' own formulas."""
    s = 1j * W

    def lag(m):
        return m.K * np.exp(-m.D * s) / (m.T * s + 1.0)

    def pid(c):
        return c.Kp * (1.0 + 1.0 / (c.Ti * s) + c.Td * s) / (1.0 + c.Tf * s + (c.Tf * s) ** 2 / 2.0)

    rows = ((pair.first, pair.on_first), (pair.on_second, pair.second))
    G = np.moveaxis(np.array([[lag(m) for m in row] for row in rows]), 2, 0)
    D = np.array([[1.0, decoupler[0]], [decoupler[1], 1.0]])
    C = np.zeros_like(G)
    C[:, 0, 0], C[:, 1, 1] = (pid(one) for one in (gains or pair.gains))
    return np.linalg.inv(np.eye(2) + G @ D @ C)


def worst_of(S):
    return max(float(np.abs(x).max()) for i in (0, 1) for x in (S[:, i, i], 1.0 - S[:, i, i]))


gain = st.one_of(st.floats(0.1, 5.0), st.floats(-5.0, -0.1))


@given(gain, gain)
@settings(max_examples=40, deadline=None)
def test_the_relative_gain_is_that_of_bristol_and_complements_the_other_pairing(k12, k21):
    assume(abs(2.0 - k12 * k21) > 0.05)
    relative = interaction(pair_of(k12, k21)).relative_gain
    K = np.array([[2.0, k12], [k21, 1.0]])
    array = K * np.linalg.inv(K).T
    assert relative == pytest.approx(array[0, 0], rel=1e-9)
    assert 1.0 - relative == pytest.approx(array[0, 1], rel=1e-7, abs=1e-9)


@given(st.floats(0.1, 10.0), st.floats(0.1, 10.0))
@settings(max_examples=20, deadline=None)
def test_interaction_does_not_depend_on_the_units_of_either_loop(pv_unit, output_unit):
    """Another unit of the first PV and of the second output scales a row and a column of `G`."""
    plain, p = interaction(pair_of()), pair_of()
    scaled = Pair(
        replace(p.first, K=p.first.K * pv_unit),
        replace(p.second, K=p.second.K * output_unit),
        replace(p.on_first, K=p.on_first.K * pv_unit * output_unit),
        p.on_second,
        (replace(GENTLE[0], Kp=GENTLE[0].Kp / pv_unit), replace(GENTLE[1], Kp=GENTLE[1].Kp / output_unit)),
    )
    found = interaction(scaled)
    assert found.relative_gain == pytest.approx(plain.relative_gain)
    for one, other in zip(found.loops, plain.loops, strict=True):
        assert (one.Ms, one.Mt, one.Ms_alone) == pytest.approx((other.Ms, other.Mt, other.Ms_alone), rel=1e-9)


@pytest.mark.parametrize(("k12", "k21"), [(0.8, 0.4), (1.2, -0.9), (-0.7, -0.7), (2.0, 0.6)])
def test_sensitivities_together_are_the_diagonal_of_the_inverse(k12, k21):
    pair = pair_of(k12, k21, (PidGains(0.6, 12.0, 0.4, 0.1), PidGains(0.9, 10.0)))
    found, S = interaction(pair), matrix_sensitivity(pair)
    assert found.stable
    for i, one in enumerate(found.loops):
        assert one.Ms == pytest.approx(np.abs(S[:, i, i]).max(), rel=0.003)
        assert one.Mt == pytest.approx(np.abs(1.0 - S[:, i, i]).max(), rel=0.003)
    assert found.worst == pytest.approx(worst_of(S), rel=0.003)


def test_the_detuning_is_the_smallest_that_keeps_the_limit():
    pair, limit = pair_of(1.2, -0.9, (PidGains(3.0, 10.0, 0.5, 0.05), PidGains(4.0, 8.0, 0.7, 0.07))), 1.4
    remedy = detuned(pair, limit)

    def slower(F):
        return [PidGains(c.Kp / F, c.Ti * F, c.Td / F, c.Tf / F) for c in pair.gains]

    F = remedy.detuning
    assert F > 1.1
    for ours, theirs in zip(remedy.gains, slower(F), strict=True):
        found = (ours.Kp, ours.Ti, ours.Td, ours.Tf)
        assert found == pytest.approx((theirs.Kp, theirs.Ti, theirs.Td, theirs.Tf))
    assert remedy.decoupler is None
    assert worst_of(matrix_sensitivity(pair, slower(F))) <= 1.008 * limit
    assert worst_of(matrix_sensitivity(pair, slower(F / 1.02))) > limit


def test_a_decoupler_by_hand():
    """`d12 = -K12/K11 = -0.4`, `d21 = -K21/K22 = -0.4`; `lambda = 2/(2 - 0.32)` multiplies both gains."""
    pair = pair_of()
    remedy = decoupled(pair, 1.7)
    assert remedy.decoupler == pytest.approx((-0.4, -0.4))
    K, D = np.array([[2.0, 0.8], [0.4, 1.0]]), np.array([[1.0, -0.4], [-0.4, 1.0]])
    np.testing.assert_allclose(K @ D, np.diag([1.68, 0.84]), atol=1e-12)
    relative, F = 2.0 / 1.68, remedy.detuning
    assert [one.Kp for one in remedy.gains] == pytest.approx([0.3 * relative / F, 0.5 * relative / F])
    assert remedy.interaction.relative_gain == 1.0


def test_a_decoupled_pair_is_judged_with_its_decoupler_in_front():
    """`d12 = -0.4` from the second output, `d21 = -0.7` from the first; no path has the dynamics of another."""
    pair = pair_of(0.8, 0.7, (PidGains(2.0, 10.0), PidGains(1.5, 8.0)))
    remedy = decoupled(pair, 1.8)
    assert remedy.decoupler == pytest.approx((-0.4, -0.7))
    S = matrix_sensitivity(pair, remedy.gains, remedy.decoupler)
    for i, one in enumerate(remedy.interaction.loops):
        assert one.Ms == pytest.approx(np.abs(S[:, i, i]).max(), rel=0.003)
        assert one.Mt == pytest.approx(np.abs(1.0 - S[:, i, i]).max(), rel=0.003)


@pytest.mark.parametrize(("k12", "k21", "relative"), [(2.0, 0.85, 6.67), (1.9, 1.0, 20.0), (2.0, 1.5, -2.0)])
def test_a_decoupler_of_a_nearly_singular_or_wrong_pairing_is_refused(k12, k21, relative):
    with pytest.raises(InputError, match="no decoupler") as caught:
        decoupled(pair_of(k12, k21), 1.4)
    assert caught.value.value == pytest.approx(relative, rel=1e-3)


def test_a_singular_process_has_an_infinite_relative_gain():
    assert math.isinf(interaction(pair_of(2.0, 1.0)).relative_gain)


def test_an_integrating_process_lets_no_decoupler_be_made():
    ramp = Integrating(0.1, 0.0, 1.0)
    gains = PidGains(2.0, 15.0)
    with pytest.raises(InputError, match="no decoupler"):
        decoupled(Pair(ramp, ramp, None, Fopdt(0.1, 5.0, 1.0), (gains, gains)), 1.7)


@pytest.mark.parametrize(
    ("k12", "k21", "words"),
    [
        (0.1, 0.1, "hardly meet"),
        (2.0, 1.5, "pairing is wrong"),
        (3.0, -1.5, "other pairing would interact less"),
    ],
)
def test_the_advice_follows_the_relative_gain(k12, k21, words):
    assert words in advice(interaction(pair_of(k12, k21)))


def test_the_advice_follows_the_margins_where_the_pairing_is_right():
    """Calm loops bear it, brisk ones lose margin, and brisk ones that oppose each other may not be stable."""
    calm = interaction(pair_of(0.8, 0.4, (PidGains(0.05, 40.0), PidGains(0.05, 40.0))))
    brisk_gains = (PidGains(2.5, 10.0), PidGains(2.5, 8.0))
    assert "margins of both bear it" in advice(calm)
    brisk = interaction(pair_of(1.2, 0.9, brisk_gains))
    assert worst_of(matrix_sensitivity(pair_of(1.2, 0.9, brisk_gains))) > 1.05 * max(
        max(one.Ms_alone, one.Mt_alone) for one in brisk.loops
    )
    assert "margins shrink" in advice(brisk)


def test_a_pair_is_written_as_json_has_it():
    written = interaction(pair_of()).to_dict()
    assert set(written) == {"relative_gain", "relative_gain_at_crossover", "stable", "loops"}
    assert [set(one) for one in written["loops"]] == [{"Ms", "Mt", "Ms_alone", "Mt_alone"}] * 2
    remedy = detuned(pair_of(), 1.7).to_dict()
    assert (remedy["decoupler"], remedy["detuning"]) == (None, 1.0)
    assert decoupled(pair_of(), 1.7).to_dict()["decoupler"] == pytest.approx([-0.4, -0.4])
