"""While loops are tuned, collections look through what is new; afterwards all rubbish goes."""

import gc
import weakref

import pytest

from autotuner.control.reporting.collector import Collector


class Knot:
    """Refers to itself: only the collector of cycles gets rid of it."""

    def __init__(self):
        self.me = self


@pytest.fixture(autouse=True)
def as_before():
    young = gc.get_threshold()
    yield
    gc.unfreeze()
    gc.set_threshold(*young)


def test_what_is_held_is_put_aside_until_nothing_runs():
    busy = [True]
    collector = Collector(lambda: busy[0])
    knot = Knot()
    gone = weakref.ref(knot)
    collector.look()
    assert gc.get_freeze_count() > 1000
    del knot
    gc.collect()
    assert gone() is not None  # put aside: not looked through
    busy[0] = False
    collector.look()
    assert gone() is None


def test_collections_by_themselves_are_rare_until_nothing_runs():
    busy, usual = [True], gc.get_threshold()
    collector = Collector(lambda: busy[0])
    collector.look()
    collector.look()
    assert gc.get_threshold() == (50_000, *usual[1:])
    busy[0] = False
    collector.look()
    assert gc.get_threshold() == usual


def test_what_is_new_is_looked_through_meanwhile():
    collector = Collector(lambda: True)
    collector.look()
    gone = weakref.ref(Knot())
    collector.look()
    assert gone() is None


def test_nothing_is_done_while_nothing_runs(monkeypatch):
    collector = Collector(lambda: False)
    monkeypatch.setattr(gc, "collect", lambda: pytest.fail("collected"))
    collector.look()
