"""A few runs of every kind of the fault-injection bench (benchmarks/safety/faults.py), which does thousands."""

import functools
from pathlib import Path

import pytest

from benchmarks.safety import faults

pytestmark = pytest.mark.usefixtures("without_diagnosis")

RUNS = 2


class AsNeeded:
    """How the plants do undisturbed, measured when asked for."""

    def __getitem__(self, index):
        return measured(index)


measured = functools.cache(faults.undisturbed)


@pytest.mark.parametrize("kind", [kind for kind in faults.KINDS if kind != faults.KILL])
def test_every_run_ends_as_required(kind):
    """The kill has its own tests, with real processes."""
    for number in range(RUNS):
        judged = faults.perform(faults.draw(kind, number, AsNeeded()))
        assert judged.faults == (), f"python benchmarks/safety/faults.py --kind {kind!r} --seed {number}: {judged}"


def test_a_run_is_the_same_for_ever():
    one, two = (faults.perform(faults.draw("timeout", 1, AsNeeded())) for _ in range(2))
    assert repr(one) == repr(two)


@pytest.mark.parametrize("broken", ["never restored", "no verdict"])
def test_the_judge_is_not_blind(broken):
    """Runs that end as they must not, made of one that did."""
    run = in_folder(faults.calm_case(3))
    assert faults.judge(run).faults == ()
    if broken == "no verdict":
        run.verdict = None
        assert "no verdict" in faults.judge(run).faults
        return
    t, pv, _, auto = run.trace[-1]
    run.trace.append((t + 1.0, pv, 55.0, auto))
    run.written.append((t, "output", 101.0))
    assert set(faults.judge(run).faults) == {"not restored", "written beyond limits"}


def in_folder(case):
    with faults.tempfile.TemporaryDirectory() as folder:
        return faults.in_virtual_time(faults.whole_run(case, Path(folder)))
