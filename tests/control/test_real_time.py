"""What keeps deadlines in a loop process: each part asked for, not permitted, and taken back."""

import asyncio
import gc
import os
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import pytest

from autotuner.control.clock import real_time
from autotuner.control.clock.real_time import Upkeep, fine_timers, woken_at
from autotuner.control.clock.ticker import Stop, Ticker
from tests.control.processes import PATIENCE_S

linux = pytest.mark.skipif(sys.platform != "linux", reason="the class is of Linux")

SPINNING = """
import asyncio, os, signal, sys
from autotuner.control.clock.real_time import claim

def in_class():
    return os.sched_getscheduler(0) == os.SCHED_FIFO

def spin():
    inherited = in_class()
    while in_class():
        pass
    return inherited

async def main():
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, sys.exit)
    return spin() if sys.argv[1] == "main" else await asyncio.to_thread(spin)

print(claim(10), asyncio.run(main()), not in_class())
"""


def test_none_is_asked_for_by_default(monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: pytest.fail("asked"), raising=False)
    assert not real_time.claim(0)


@pytest.fixture
def limits(monkeypatch):
    """Let this process keep its limits and its signals."""
    monkeypatch.setattr(real_time, "_limit", lambda: None)
    monkeypatch.setattr(real_time, "_lock_memory", lambda: None)


@linux
def test_without_permission_all_stays_as_it_is_and_the_log_says_so(monkeypatch, caplog, limits):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not real_time.claim(50)
    assert "CAP_SYS_NICE" in caplog.text


@linux
@pytest.mark.realtime
@pytest.mark.alone
@pytest.mark.parametrize("thread", ["main", "other"])
def test_a_thread_that_never_waits_is_put_back_with_all_others(thread):
    """Threads inherit the class; without permission none is ever in it, and the program ends at once."""
    done = subprocess.run(
        [sys.executable, "-c", SPINNING, thread], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() in [["True"] * 3, ["False", "False", "True"]]


@linux
def test_all_threads_are_put_back(monkeypatch):
    put = {}
    monkeypatch.setattr(os, "sched_setscheduler", lambda thread, policy, _: put.update({thread: policy}))
    real_time._demote(0, None)
    assert put[threading.get_native_id()] == os.SCHED_OTHER
    assert put.keys() == {int(task.name) for task in Path("/proc/self/task").iterdir()}


@linux
async def test_an_alarm_rings_before_each_deadline_in_order_and_no_more(monkeypatch):
    rung, loop = [], asyncio.get_running_loop()
    ring = real_time.Alarm._ring
    monkeypatch.setattr(real_time.Alarm, "_ring", lambda alarm: (rung.append(loop.time()), ring(alarm)))
    with fine_timers():
        begun_s = loop.time()
        for after_s in (0.3, 0.1, 0.2, 0.1):
            assert begun_s < woken_at(begun_s + after_s, 0.01) < begun_s + after_s
        await asyncio.sleep(0.5)
    assert [round(at_s - begun_s, 1) for at_s in rung] == [0.1, 0.2, 0.3]
    assert woken_at(begun_s, 0.01) == begun_s  # there is none any more: the event loop's own timers do


@linux
async def test_a_ticker_is_woken_before_its_deadlines_and_waits_for_the_rest(monkeypatch):
    asked = []
    monkeypatch.setattr(real_time.Alarm, "ring_at", lambda _, woken_s: asked.append(woken_s))
    with fine_timers():
        ticker, stop = Ticker(0.01), Stop()
        ticks = [await ticker.tick(stop) for _ in range(4)]
    due_s = [tick.t - tick.lateness_s for tick in ticks[1:]]
    assert [ticker.since(woken_s) for woken_s in asked] == pytest.approx([one_s - 250e-6 for one_s in due_s])
    assert all(tick.t >= one_s for tick, one_s in zip(ticks[1:], due_s, strict=True))


@linux
async def test_without_such_a_timer_the_usual_ones_do(monkeypatch):
    def refuse(_):
        raise OSError

    monkeypatch.setattr(real_time, "Alarm", refuse)
    with fine_timers():
        ticker, stop = Ticker(0.01), Stop()
        assert [(await ticker.tick(stop)).missed >= 0 for _ in range(3)] == [True] * 3


@pytest.fixture
def latency(monkeypatch, tmp_path):
    """A file in place of the kernel's."""
    file = tmp_path / "cpu_dma_latency"
    file.touch()
    monkeypatch.setattr(real_time, "LATENCY", file)
    return file


@pytest.fixture(autouse=True)
def as_before():
    young = gc.get_threshold()
    yield
    gc.unfreeze()
    gc.set_threshold(*young)


def held(file):
    """Whether this process has the file open."""
    return any(link.samefile(file) for link in Path("/proc/self/fd").iterdir() if link.exists())


@linux
def test_the_processors_stay_awake_while_a_loop_is_driven(latency):
    upkeep, seen = Upkeep(awake=True), []
    for busy in (False, True, True, False):
        upkeep.look(busy=busy)
        seen.append(held(latency))
    assert seen == [False, True, True, False]
    assert latency.read_bytes() == bytes(4)


@linux
def test_where_that_is_not_permitted_the_log_says_so_once(latency, caplog):
    latency.unlink()
    upkeep = Upkeep(awake=True)
    upkeep.look(busy=True)
    upkeep.look(busy=True)
    assert caplog.text.count("processors may halt") == 1


@linux
def test_without_the_class_they_halt_as_they_like(latency):
    Upkeep(awake=False).look(busy=True)
    assert latency.read_bytes() == b""


class Knot:
    """Refers to itself: only the collector of cycles gets rid of it."""

    def __init__(self):
        self.me = self


def test_what_is_held_is_put_aside_until_nothing_runs():
    upkeep, knot = Upkeep(awake=False), Knot()
    gone = weakref.ref(knot)
    upkeep.look(busy=True)
    assert gc.get_freeze_count() > 1000
    del knot
    gc.collect()
    assert gone() is not None  # put aside: not looked through
    upkeep.look(busy=False)
    assert gone() is None


def test_collections_by_themselves_are_rare_until_nothing_runs():
    upkeep, usual = Upkeep(awake=False), gc.get_threshold()
    upkeep.look(busy=True)
    upkeep.look(busy=True)
    assert gc.get_threshold() == (50_000, *usual[1:])
    upkeep.look(busy=False)
    assert gc.get_threshold() == usual


def test_what_is_new_is_looked_through_meanwhile():
    upkeep = Upkeep(awake=False)
    upkeep.look(busy=True)
    gone = weakref.ref(Knot())
    upkeep.look(busy=True)
    assert gone() is None


def test_nothing_is_done_while_nothing_runs(monkeypatch):
    upkeep = Upkeep(awake=False)
    monkeypatch.setattr(gc, "collect", lambda: pytest.fail("collected"))
    upkeep.look(busy=False)


@linux
def test_a_process_of_many_loops_does_not_wait_awake():
    async def heads(loops):
        with fine_timers():
            now_s = asyncio.get_running_loop().time() + 60.0
            return [now_s - woken_at(now_s, 0.1) for _ in range(loops)]

    one, *_, last = asyncio.run(heads(100))
    assert 0.0 < one <= real_time.HEAD_START_S + 1e-9
    assert last == 0.0
