"""An effect that leaves only noise of the fitted part and fails after it: what comes later decides.

The PV is a sum of K (1 - e^{-(t - t_i - D)/T}) for each move of the output and of the load: a closed form.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.procedure import LEFT_OPEN
from autotuner.core.diagnosis.search import trace
from autotuner.core.diagnosis.search.trace import Trace

pytestmark = pytest.mark.usefixtures("without_gains")

K, T, DELAY_S, SIGMA, COUNT = 2.0, 12.0, 3.0, 0.05, 400
LOAD, BEGINS_S, ENDS_S = 3.0, 140.0, 262.0
"""A load at the input, output units: it begins in the fitted part and ends in the selection part."""


def answer(t, at_s, size):
    return -K * size * np.expm1(-np.maximum(t - at_s, 0.0) / T)


def loaded(*changes):
    """Return the record of a process under loads that begin at some times, s, with some sizes, output units."""
    t = np.arange(float(COUNT))
    output = np.repeat(np.random.default_rng(2).choice([-8.0, -4.0, 4.0, 8.0], COUNT // 20), 20)
    output[:20] = 0.0
    moves = np.flatnonzero(np.diff(output)) + 1
    pv = sum(answer(t, t[at] + DELAY_S, output[at] - output[at - 1]) for at in moves)
    pv = pv + sum(answer(t, at_s, size) for at_s, size in changes)
    return Recording(t, 40.0 + output, 100.0 + pv + np.random.default_rng(3).normal(0.0, SIGMA, COUNT))


@pytest.fixture
def searches(monkeypatch):
    """Return what each search was asked for: whether it was patient, and whether it went to its end."""
    asked, search = [], trace.trace

    def noted(*args, **options):
        found = search(*args, **options)
        assert isinstance(found, Trace)
        asked.append((options.get("patient", True), found.complete))
        return found

    monkeypatch.setattr("autotuner.core.diagnosis.procedure.trace", noted)
    return asked


def test_a_load_that_ends_after_the_fitted_part_is_found_without_the_long_searches(among, searches, monkeypatch):
    among("load_step")
    monkeypatch.setattr(trace, "_each_with_processes", lambda *_: pytest.fail("a load leaves only noise"))
    found = diagnose(loaded((BEGINS_S, LOAD), (ENDS_S, -LOAD)))
    assert searches == [(False, False), (False, True)]
    assert [(e.name, e.form) for e in found.effects] == [("load_step", "ends again")]
    assert found.verdict == "explained"
    assert LEFT_OPEN in found.notes
    sizes = found.effects[0].parameters
    assert sizes["at_s"] == pytest.approx(BEGINS_S, abs=1.0)
    assert sizes["at_s"] + sizes["lasts_s"] == pytest.approx(ENDS_S, abs=1.0)


def test_a_load_that_lasts_leaves_nothing_open(among, searches):
    among("load_step")
    found = diagnose(loaded((BEGINS_S, LOAD)))
    assert searches == [(False, True)]
    assert [(e.name, e.form) for e in found.effects] == [("load_step", "")]
    assert LEFT_OPEN not in found.notes


def test_where_more_samples_do_not_decide_the_search_goes_to_its_end(among, searches):
    among("load_step")
    later = [(at_s, size) for at_s, size in zip((250.0, 265.0, 280.0, 295.0), (-5.0, 7.0, -9.0, 6.0), strict=True)]
    found = diagnose(loaded((BEGINS_S, LOAD), *later))
    assert searches == [(False, False), (False, True), (True, True), (True, True)]
    assert found.verdict != "explained"
