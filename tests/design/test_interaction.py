"""Two loops that disturb each other: closed forms by hand, and loops of the simulator."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from autotuner.core.design import PidGains, design, margins
from autotuner.core.design.interaction import Pair, advice, decoupled, detuned, interaction
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.core.model.process import Fopdt, Integrating
from autotuner.errors import InputError
from autotuner_sim import Fopdt as SimFopdt
from autotuner_sim import SopdtOverdamped
from autotuner_sim.coupled import coupled_plants

SCAN_S = 0.1
designed = functools.cache(design)
"""The same gains, computed once: several tests judge them."""


def pair_of(k12, k21, T12=10.0, D12=1.0, detuning=1.0):
    first, second = Fopdt(2.0, 10.0, 1.0), Fopdt(1.0, 8.0, 1.0)
    gains = [replace(one, Kp=one.Kp / detuning) for one in (designed(first).gains, designed(second).gains)]
    cross = [Fopdt(k, T12, D12) if k else None for k in (k12, k21)]
    return Pair(first, second, cross[0], cross[1], (gains[0], gains[1]))


def simulated(pair, gains, decoupler=(0.0, 0.0), load=0.0, set_point=0.0, duration_s=300.0):
    """Return both PVs of the simulator's pair after steps of load and set point in the first loop."""
    own = tuple(SimFopdt(model.K, model.T, model.D) for model in (pair.first, pair.second))
    cross = tuple(SopdtOverdamped(model.K, model.T, 0.0, model.D) for model in (pair.on_first, pair.on_second))
    channels = coupled_plants(own, cross)
    settings = [PidSettings(one) for one in gains]
    states = [started(one, -SCAN_S, 0.0, 0.0, 0.0) for one in settings]
    pv = np.empty((round(duration_s / SCAN_S), 2))
    for k in range(len(pv)):
        t = k * SCAN_S
        for channel in channels:
            channel.advance(t)
        pv[k] = [channel.pv for channel in channels]
        aims = (set_point, 0.0)
        states = [step(s, state, t, y, r) for s, state, y, r in zip(settings, states, pv[k], aims, strict=True)]
        v1, v2 = (state.output for state in states)
        channels[0].output = v1 + decoupler[0] * v2 + load
        channels[1].output = decoupler[1] * v1 + v2
    return pv


def test_the_relative_gain_by_hand():
    """Bristol: `K11 K22/(K11 K22 - K12 K21)`; the distillation column of Wood and Berry has 2.01."""
    wood_berry = Pair(
        Fopdt(12.8, 16.7, 1.0),
        Fopdt(-19.4, 14.4, 3.0),
        Fopdt(-18.9, 21.0, 3.0),
        Fopdt(6.6, 10.9, 7.0),
        (PidGains(0.1, 20.0), PidGains(-0.05, 20.0)),
    )
    assert interaction(wood_berry).relative_gain == pytest.approx(12.8 * 19.4 / (12.8 * 19.4 - 18.9 * 6.6))
    assert interaction(wood_berry).relative_gain == pytest.approx(2.01, abs=0.01)
    assert interaction(pair_of(1.0, 0.5)).relative_gain == pytest.approx(2.0 / (2.0 - 0.5))


def test_loops_that_meet_one_way_only_keep_their_margins():
    pair = pair_of(0.9, 0.0)
    found = interaction(pair)
    assert found.relative_gain == 1.0
    for one, model, gains in zip(found.loops, (pair.first, pair.second), pair.gains, strict=True):
        alone = margins(model, gains)
        assert one.Ms == pytest.approx(alone.Ms, rel=0.002)
        assert one.Ms_alone == pytest.approx(alone.Ms, rel=0.002)
        assert one.Mt == pytest.approx(alone.Mt, rel=0.002)
    assert "hardly meet" in advice(found)


def test_equal_processes_by_closed_form():
    """`G11 = G22 = g`, `G12 = G21 = a g`: the pair is two loops of `(1 + a) g` and `(1 - a) g`.

    `S_1' = (S_+ + S_-)/2`, with the sensitivities of these two.
    """
    a, g = 0.4, Fopdt(1.0, 10.0, 1.0)
    gains = designed(g).gains
    gains = replace(gains, Kp=gains.Kp / 2.0)
    found = interaction(Pair(g, g, replace(g, K=a), replace(g, K=a), (gains, gains)))
    w = np.geomspace(1e-3, 1e2, 200_000)
    s = 1j * w
    C = (gains.Kp * (1.0 + 1.0 / (s * gains.Ti) + s * gains.Td)) / (1.0 + s * gains.Tf + (s * gains.Tf) ** 2 / 2.0)
    L = C * np.exp(-s) / (10.0 * s + 1.0)
    S = (1.0 / (1.0 + (1.0 + a) * L) + 1.0 / (1.0 + (1.0 - a) * L)) / 2.0
    assert found.loops[0].Ms == pytest.approx(np.abs(S).max(), rel=0.002)
    assert found.loops[1].Mt == pytest.approx(np.abs(1.0 - S).max(), rel=0.002)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_the_border_of_stability_is_that_of_two_equal_loops(factor):
    """Equal processes: the pair is unstable from where the loop of `(1 + a) g` is."""
    g, a = Fopdt(1.0, 10.0, 1.0), 0.6
    gains = designed(g).gains
    largest = margins(replace(g, K=1.0 + a), gains).gain_margin
    gains = replace(gains, Kp=factor * largest * gains.Kp)
    found = interaction(Pair(g, g, replace(g, K=a), replace(g, K=a), (gains, gains)))
    assert found.stable is (factor < 1.0)
    assert (found.loops[0].Ms is None) is (factor > 1.0)


def test_a_negative_relative_gain_is_unstable_and_named():
    found = interaction(pair_of(2.0, 1.5))
    assert found.relative_gain < 0.0
    assert not found.stable
    assert "the other PV" in advice(found)
    with pytest.raises(InputError, match="slower controllers"):
        detuned(pair_of(2.0, 1.5), 1.6)
    with pytest.raises(InputError, match="no decoupler"):
        decoupled(pair_of(2.0, 1.5), 1.6)


def test_a_loop_that_is_unstable_alone_is_refused():
    pair = pair_of(0.5, 0.5)
    wild = replace(pair.gains[0], Kp=5.0 * pair.gains[0].Kp)
    with pytest.raises(InputError, match="not stable alone"):
        interaction(replace(pair, gains=(wild, pair.gains[1])))


def test_detuned_loops_keep_the_limit_and_settle_in_the_simulator():
    pair = pair_of(1.2, -0.9, D12=0.5)
    before = interaction(pair)
    remedy = detuned(pair, 1.4)
    assert before.worst > 1.5
    assert remedy.detuning > 1.1
    assert remedy.interaction.worst <= 1.41
    assert interaction(replace(pair, gains=remedy.gains)).worst == pytest.approx(remedy.interaction.worst, rel=1e-3)
    pv = simulated(pair, remedy.gains, load=1.0)
    assert np.abs(pv[-100:]).max() < 0.01 * np.abs(pv).max()


def test_a_decoupler_leaves_the_other_pv_alone_in_the_simulator():
    """With equal dynamics in all paths a static decoupler is exact: a set-point step moves the other PV no more."""
    first, second = Fopdt(2.0, 10.0, 1.0), Fopdt(1.0, 10.0, 1.0)
    gains = designed(first).gains, designed(second).gains
    pair = Pair(first, second, Fopdt(1.2, 10.0, 1.0), Fopdt(0.6, 10.0, 1.0), gains)
    remedy = decoupled(pair, 1.4)
    assert remedy.decoupler == pytest.approx((-0.6, -0.6))
    assert remedy.detuning == pytest.approx(1.0, abs=0.02)
    assert remedy.interaction.worst <= 1.41
    coupled = simulated(pair, gains, set_point=1.0)
    helped = simulated(pair, remedy.gains, remedy.decoupler, set_point=1.0)
    assert np.abs(coupled[:, 1]).max() > 0.1
    assert np.abs(helped[:, 1]).max() < 1e-9
    assert helped[-1, 0] == pytest.approx(1.0, abs=0.01)


def test_an_integrating_pair_has_no_relative_gain_at_rest():
    model = Integrating(0.1, 0.0, 1.0)
    gains = design(model).gains
    found = interaction(Pair(model, model, replace(model, K=0.02), replace(model, K=0.02), (gains, gains)))
    assert found.relative_gain is None
    assert found.stable
    assert found.relative_gain_at_crossover == pytest.approx(1.0 / (1.0 - 0.04))
    assert math.isfinite(found.worst)
