"""The bench's optimum of a process, searched for from controllers that are not near it."""

import csv

import pytest

from benchmarks.accuracy.tuning.gains import OPTIMA, best_error
from benchmarks.baselines.amigo_batch import batch, ultimate


@pytest.mark.long  # a bench; what the product designs is in test_controller_advice
@pytest.mark.parametrize(("name", "Ti_over_Pu"), [
    ("P1 T=6", 0.8),
    pytest.param("P4 n=5", 0.8, marks=pytest.mark.long),
    pytest.param("P6 L=0.5", float("inf"), marks=pytest.mark.long),
])  # fmt: skip
def test_a_pi_or_p_controller_is_no_obstacle(name, Ti_over_Pu):
    process = next(process for process in batch() if process.name == name)
    with OPTIMA.open() as file:
        rows = {row["process"]: row for row in csv.DictReader(file) if row["controller"] == "filtered"}
    Ku, Pu = ultimate(process)
    assert best_error(process, [0.3 * Ku, Ti_over_Pu * Pu, 0.0]) == pytest.approx(float(rows[name]["IAE"]), rel=1e-3)
