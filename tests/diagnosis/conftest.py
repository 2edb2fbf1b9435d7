"""What keeps a diagnosis to the part of it that a test judges."""

import pytest

from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.findings import report
from autotuner.core.diagnosis.search import trace


@pytest.fixture
def without_gains(monkeypatch):
    """Leave out the gains, which take a third of the time and have tests of their own."""
    monkeypatch.setattr(report, "both_gains", lambda *_: report.NO_GAINS)


@pytest.fixture(params=["rivals", pytest.param("whole catalogue", marks=pytest.mark.long)])
def among(request, monkeypatch):
    """Return a function that keeps the search to effects of some names: one and those that are taken for it.

    The search is the product's; `run.py long` has the whole catalogue.
    """

    def keep(*names):
        def kept(*args):
            return tuple(effect for effect in catalogue(*args) if effect.name in names)

        if request.param == "rivals":
            monkeypatch.setattr(trace, "catalogue", kept)

    return keep
