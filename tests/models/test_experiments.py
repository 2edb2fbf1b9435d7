"""The batch that makes training data, sample by sample against the simulator, which knows nothing of it."""

import numpy as np
import pytest

from autotuner_models.learned.draw import STRUCTURES, draw_processes, rows_of, turnover
from autotuner_models.learned.experiments import Processes, Relays, run
from autotuner_sim import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.stepped import SteppedPlant

PLANTS = (
    (Fopdt(1.0, 20.0, 7.3), (1.0, 1.0, 20.0, 0.0, 7.3)),
    (Fopdt(1.0, 5.0, 12.0), (1.0, 1.0, 5.0, 0.0, 12.0)),
    (SopdtOverdamped(1.0, 15.0, 6.0, 4.4), (1.0, 1.0, 21.0, 90.0, 4.4)),
    (SopdtUnderdamped(1.0, 64.0, 5.0, 9.9), (1.0, 1.0, 5.0, 64.0, 9.9)),
    (Integrating(0.2, 3.0, 6.5), (0.2, 0.0, 1.0, 3.0, 6.5)),
)


def test_every_sample_is_that_of_the_simulator():
    count = len(PLANTS)
    processes = Processes(*np.array([columns for _, columns in PLANTS]).T)
    relays = Relays(np.full(count, -1.0), np.full(count, 1.5), np.full(count, 0.05), np.zeros(count))
    records = run(processes, relays, 6, 600, np.random.default_rng(0))
    assert (records.switches > 0).all()
    for i, (plant, _) in enumerate(PLANTS):
        device = SteppedPlant(plant)
        for k, output in enumerate(records.output[:, i]):
            device.advance(float(k))
            assert records.pv[k, i] == pytest.approx(device.pv, abs=1e-10)
            device.output = output


def test_the_relay_switches_at_the_first_sample_beyond_its_dead_zone():
    processes = Processes(*np.array([PLANTS[0][1]]).T)
    relays = Relays(np.array([-1.0]), np.array([1.0]), np.array([0.1]), np.array([0.0]))
    records = run(processes, relays, 4, 400, np.random.default_rng(0))
    high = records.output[:, 0] > 0.0
    for row in records.switches[:, 0]:
        before, after = records.pv[row - 1, 0], records.pv[row, 0]
        assert (before <= 0.1 < after) if high[row - 1] else (after < -0.1 <= before)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_turnover_is_where_the_response_lags_by_half_a_turn(structure):
    p = draw_processes(structure, 50, np.random.default_rng(1), {})
    s = 1j * turnover(p)
    response = p.b / (p.a0 + p.a1 * s + p.a2 * s * s) * np.exp(-s * p.D)
    assert response.imag == pytest.approx(0.0, abs=1e-9)
    assert (response.real < 0.0).all()


def test_the_same_seed_gives_the_same_rows_and_another_gives_others():
    first, again, other = (rows_of("fopdt", 32, seed) for seed in ((1, 0, 0), (1, 0, 0), (1, 0, 1)))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.X[:5], other.X[:5])
