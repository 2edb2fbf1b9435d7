"""The real-time class: asked for, not permitted, and taken back from a thread that never waits."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from autotuner.control.clock import real_time, wakefulness
from tests.control.processes import PATIENCE_S

linux = pytest.mark.skipif(sys.platform != "linux", reason="the class is of Linux")

SPINNING = """
import os, threading
from autotuner.control.clock.real_time import claim, guard

def spin():
    claimed.append(claim(10))
    while os.sched_getscheduler(0) == os.SCHED_FIFO:
        pass

claimed = []
guard()
thread = threading.Thread(target=spin)
thread.start()
thread.join()
print(claimed[0])
"""


def test_none_is_asked_for_by_default():
    assert not real_time.claim(0)


@linux
def test_without_permission_all_stays_as_it_is_and_the_log_says_so(monkeypatch, caplog):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not real_time.claim(50)
    assert "CAP_SYS_NICE" in caplog.text


@linux
@pytest.mark.realtime
@pytest.mark.alone
def test_a_thread_that_never_waits_is_put_back():
    """Without permission it never was in the class, and ends at once."""
    done = subprocess.run(
        [sys.executable, "-c", SPINNING], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in {"True", "False"}


@pytest.fixture
def latency(monkeypatch, tmp_path):
    """A file in place of the kernel's."""
    file = tmp_path / "cpu_dma_latency"
    file.touch()
    monkeypatch.setattr(wakefulness, "LATENCY", file)
    return file


@pytest.fixture
def scheduler(monkeypatch, latency):
    """Threads by the class and priority they were put into last; this process has claimed 50 for a thread 1."""
    put = {}
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda thread, policy, param: put.update({thread: (policy, param.sched_priority)})
    )
    monkeypatch.setattr(real_time, "_claimed", {1: 50})
    monkeypatch.setattr(real_time, "_lent", set())
    return put


@linux
def test_while_a_tuning_runs_who_may_hold_the_lock_has_nearly_the_priority_of_who_waits_for_it(scheduler):
    busy, here = [False], threading.get_native_id()
    lender = real_time.Lender(lambda: busy[0])
    lender._used_s = 1e9  # since then little was used
    lender.look()
    assert scheduler == {}
    busy[0], lender._used_s = True, 1e9
    lender.look()
    assert scheduler[here] == (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 49)
    assert 1 not in scheduler
    busy[0] = False
    lender.look()
    assert scheduler[here] == (os.SCHED_OTHER, 0)


@linux
def test_nothing_is_lent_without_one_who_claimed_nor_to_those_who_use_much(scheduler, monkeypatch):
    lender, here = real_time.Lender(lambda: True), threading.get_native_id()
    used_s = iter([0.0, 1e6])
    monkeypatch.setattr(real_time, "_used_s", lambda: next(used_s))
    lender._used_s = 1e9
    lender.look()
    assert scheduler[here][1] == 49
    lender.look()
    assert scheduler[here] == (os.SCHED_OTHER, 0)
    scheduler.clear()
    real_time._claimed.clear()
    monkeypatch.setattr(real_time, "_used_s", lambda: 0.0)
    lender.look()
    assert scheduler == {}


@linux
def test_what_is_lent_is_taken_back_before_the_loops_lose_their_own(scheduler):
    lender = real_time.Lender(lambda: True)
    lender._used_s = 1e9
    lender.look()
    scheduler.clear()
    real_time._demote(0, None)
    assert scheduler[threading.get_native_id()] == (os.SCHED_OTHER, 0)
    assert 1 not in scheduler
    real_time._demote(0, None)
    assert scheduler[1] == (os.SCHED_OTHER, 0)


def held(file):
    """Whether this process has the file open."""
    return any(link.samefile(file) for link in Path("/proc/self/fd").iterdir() if link.exists())


@linux
def test_the_processors_stay_awake_while_a_tuning_runs(scheduler, latency):
    busy = [False]
    lender = real_time.Lender(lambda: busy[0])
    seen = []
    for busy[0] in (False, True, True, False):
        lender.look()
        seen.append(held(latency))
    assert seen == [False, True, True, False]
    assert latency.read_bytes() == bytes(4)


@linux
def test_where_that_is_not_permitted_the_log_says_so_once(scheduler, latency, caplog):
    latency.unlink()
    lender = real_time.Lender(lambda: True)
    lender.look()
    lender.look()
    assert caplog.text.count("processors may sleep") == 1


@linux
def test_without_the_class_they_sleep_as_they_like(latency, monkeypatch):
    monkeypatch.setattr(real_time, "_claimed", {})
    real_time.Lender(lambda: True).look()
    assert latency.read_bytes() == b""
