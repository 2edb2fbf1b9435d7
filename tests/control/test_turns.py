"""Turns at the interpreter's lock: what can wait begins where the thread of the loops will not want it soon."""

import asyncio
import sys
import threading

import pytest

from autotuner.control.clock import turns as module
from autotuner.control.clock.event_loop import fine_event_loop
from autotuner.control.clock.turns import AGAIN_S, LONGEST_S, ROOM_S, WORK_S, Turns, courteous_event_loop

linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the loops have no fine timers")


@pytest.fixture
def slept(monkeypatch):
    """Return how long was slept, on a clock that only sleeping moves from 100 s on."""
    slept = []
    monkeypatch.setattr(module, "clock", lambda: 100.0 + sum(slept))
    return slept


def test_nobody_gives_way_while_nothing_is_due(slept):
    turns = Turns()
    turns.give_way(slept.append)
    turns.wanted(100.1, 100.2)
    turns.free()
    turns.give_way(slept.append)
    assert slept == []


def test_what_has_room_begins_at_once(slept):
    turns = Turns()
    turns.wanted(100.0 + 1.01 * ROOM_S, 100.01)
    turns.give_way(slept.append)
    assert slept == []


def test_what_has_no_room_waits_for_the_work_that_is_due(slept):
    turns = Turns()

    def sleep(delay_s):
        slept.append(delay_s)
        turns.wanted(100.01, 100.0105)

    turns.wanted(100.0 + 0.5 * ROOM_S, 100.0005)
    turns.give_way(sleep)
    assert slept == [pytest.approx(0.0005 + WORK_S)]


def test_work_that_takes_longer_is_looked_at_again(slept):
    turns = Turns()

    def sleep(delay_s):
        slept.append(delay_s)
        if len(slept) == 3:
            turns.free()

    turns.wanted(99.9995, 99.9998)
    turns.at_work()
    turns.give_way(sleep)
    assert slept == pytest.approx([AGAIN_S] * 3)


def test_nobody_gives_way_for_ever(slept):
    turns = Turns()
    turns.at_work()
    turns.give_way(slept.append)
    assert LONGEST_S <= sum(slept) < LONGEST_S + 2.0 * AGAIN_S


class Told(Turns):
    """Turns that keep what they are told, and in which nobody has to wait."""

    def __init__(self):
        super().__init__()
        self.told = []
        self.freed = threading.Event()

    def wanted(self, asked_s, due_s):
        self.told.append(("wanted", asked_s < due_s))

    def at_work(self):
        self.told.append("at work")

    def free(self):
        self.told.append("free")
        self.freed.set()

    def give_way(self):
        self.told.append("gave way")


def test_each_round_of_the_courteous_event_loop_gives_way():
    turns = Told()

    async def three_rounds():
        for _ in range(3):
            await asyncio.sleep(0)
        return len(turns.told)

    with asyncio.Runner(loop_factory=lambda: courteous_event_loop(turns)) as runner:
        assert runner.run(three_rounds()) >= 3
    assert set(turns.told) == {"gave way"}


@linux
def test_the_event_loop_of_the_loops_tells_when_it_wants_the_lock():
    turns = Told()

    async def one_deadline():
        turns.told.clear()
        await asyncio.sleep(0.002)
        told = turns.told[:2]
        turns.told.clear()
        turns.freed.clear()
        await asyncio.to_thread(turns.freed.wait)  # nothing is due: another thread wakes it
        return told, turns.told

    with asyncio.Runner(loop_factory=lambda: fine_event_loop(turns)) as runner:
        for_a_deadline, for_nothing = runner.run(one_deadline())
    assert for_a_deadline == [("wanted", True), "at work"]
    assert "free" in for_nothing


def test_where_event_loops_have_no_selector_the_usual_one_is_used(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    with asyncio.Runner(loop_factory=lambda: courteous_event_loop(Told())) as runner:
        assert runner.run(asyncio.sleep(0.001, "slept")) == "slept"
