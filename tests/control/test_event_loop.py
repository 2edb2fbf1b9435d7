"""The event loop with timers of the kernel: it does what every event loop does, and falls back where there are none."""

import asyncio
import selectors
import socket
import sys
import time
from pathlib import Path

import pytest

from autotuner.control.clock import event_loop as fine_loop
from autotuner.control.clock.event_loop import fine_event_loop
from autotuner.control.clock.turns import Turns

linux = pytest.mark.skipif(sys.platform != "linux", reason="timerfd is of Linux")


def alone(test):
    """Mark a test that measures the machine's time."""
    return pytest.mark.realtime(pytest.mark.alone(test))


def run(main):
    with asyncio.Runner(loop_factory=fine_event_loop) as runner:
        return runner.run(main)


@linux
@alone
def test_no_timer_is_early_and_they_go_off_in_order():
    async def main():
        loop, seen, all_seen = asyncio.get_running_loop(), [], asyncio.Event()
        begun = loop.time()
        for delay_s in (0.03, 0.0, 0.0102, 0.01005, 0.0101, 0.02):
            loop.call_at(begun + delay_s, lambda delay_s=delay_s: seen.append((delay_s, loop.time() - begun)))
        loop.call_at(begun + 0.04, all_seen.set)
        await all_seen.wait()
        return seen

    seen = run(main())
    assert [delay_s for delay_s, _ in seen] == [0.0, 0.01005, 0.0101, 0.0102, 0.02, 0.03]
    assert all(waited_s >= delay_s - 1e-6 for delay_s, waited_s in seen)


@linux
@alone
def test_files_and_calls_from_other_threads_wake_it_before_a_timer():
    async def main():
        here, there = socket.socketpair()
        here.setblocking(False)
        timer = asyncio.create_task(asyncio.sleep(60.0))
        with here, there:
            there.send(b"1")
            got = await asyncio.get_running_loop().sock_recv(here, 1)
            got += await asyncio.to_thread(lambda: b"2")
            await asyncio.sleep(0.001)
        timer.cancel()
        return got

    assert run(main()) == b"12"


@linux
@alone
def test_files_are_looked_at_however_thick_deadlines_come():
    async def main():
        loop, turns = asyncio.get_running_loop(), 0

        def again():
            nonlocal turns
            turns += 1
            if turns < 100_000:
                loop.call_later(3e-5, again)

        here, there = socket.socketpair()
        here.setblocking(False)
        again()
        with here, there:
            there.send(b"1")
            await loop.sock_recv(here, 1)  # it is there at once
            loop.call_later(0.002, there.send, b"2")
            await loop.sock_recv(here, 1)
        seen, turns = turns, 100_000
        return seen

    assert run(main()) < 10_000


@linux
@alone
def test_one_that_was_woken_from_elsewhere_takes_no_processor_time_afterwards():
    async def main():
        await asyncio.to_thread(lambda: None)
        begun_s = time.thread_time()
        await asyncio.sleep(0.3)
        return time.thread_time() - begun_s

    assert run(main()) < 0.1


@linux
def test_head_starts_are_for_those_that_come_singly():
    loop = fine_event_loop()
    try:
        given = [loop.head_start_s(1.0 + 1e-4 * k) > 0.0 for k in range(20)]
    finally:
        loop.close()
    assert given[0]
    assert 2 <= sum(given) <= 4


@linux
@pytest.mark.parametrize("lost", [0, 1, 3])
def test_who_waits_for_the_lock_begins_anew_as_one_who_has_to_wait_long(monkeypatch, lost):
    """Letting go is repeated where another thread was faster; only then is the short interval this thread's own."""
    now_s, seen = [0.0], []

    def clock():
        now_s[0] += 1e-6
        return now_s[0]

    def let_go():
        seen.append(sys.getswitchinterval())
        now_s[0] += 1e-3 if len(seen) <= lost else 1e-6

    before = sys.getswitchinterval()
    selector = fine_loop.FineSelector(Turns())
    try:
        monkeypatch.setattr(fine_loop, "clock", clock)
        selector._let_go = let_go
        selector._calm(0.01)
        assert seen == [pytest.approx(fine_loop.ASKED_S)] * (fine_loop.OTHERS + lost)
        assert sys.getswitchinterval() == pytest.approx(fine_loop.HELD_S)
        selector._calm(now_s[0] + fine_loop.CALM_S)  # it is too late for that
        assert len(seen) == fine_loop.OTHERS + lost
    finally:
        selector.close()
    assert sys.getswitchinterval() == before


@linux
def test_the_switch_interval_is_given_back():
    before = sys.getswitchinterval()
    run(asyncio.sleep(0.001))
    assert sys.getswitchinterval() == before


@linux
def test_the_timer_is_given_back():
    def files():
        return sorted(str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink())

    async def main():
        return [name for name in files() if "timerfd" in name]

    assert run(main()) == ["anon_inode:[timerfd]"]
    assert not [name for name in files() if "timerfd" in name]
    selector = fine_loop.FineSelector(Turns())
    selector.close()
    selector.close()


@linux
@pytest.mark.parametrize("error", [OSError(24, "Too many open files"), AttributeError("timerfd_create")])
def test_where_there_is_no_timer_the_usual_event_loop_is_used(monkeypatch, error):
    def refuse():
        raise error

    monkeypatch.setattr(fine_loop, "_timer", refuse)
    with asyncio.Runner(loop_factory=fine_event_loop) as runner:
        assert not isinstance(runner.get_loop()._selector, fine_loop.FineSelector)
        assert runner.run(asyncio.sleep(0.001, "slept")) == "slept"


def test_on_other_systems_the_usual_event_loop_is_used(monkeypatch):
    monkeypatch.setattr(sys, "platform", "other")
    with asyncio.Runner(loop_factory=fine_event_loop) as runner:
        assert type(runner.get_loop()._selector) is selectors.DefaultSelector
