"""The missed-tick policy as a pure function, and the ticker in virtual time."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.control.clock.ticker import Stop, Ticker, next_index


@given(elapsed=st.floats(0.0, 1e6), period=st.floats(1e-3, 1e4))
def test_the_next_deadline_lies_ahead_by_at_most_a_period(elapsed, period):
    ahead = next_index(elapsed, period) * period - elapsed
    assert -1e-6 * period <= ahead <= period * (1.0 + 1e-6) or next_index(elapsed, period) == 1


@given(index=st.integers(0, 10**6), period=st.sampled_from([0.1, 0.3, 1.0, 7.0]))
def test_a_deadline_reached_is_never_repeated(index, period):
    """At the very moment of a deadline, however it was rounded, the next one is due."""
    assert next_index(index * period, period) == index + 1


def test_ticks_do_not_drift_and_late_ones_are_skipped(virtual):
    async def main():
        ticker, stop, seen = Ticker(0.1), Stop(), []
        while len(seen) < 6:
            tick = await ticker.tick(stop)
            seen.append((round(tick.t, 6), round(tick.lateness_s, 6), tick.missed))
            await asyncio.sleep(0.25 if len(seen) == 2 else 0.03)
        stop.set()
        assert await ticker.tick(stop) is None
        return seen

    assert virtual(main()) == [
        (0.0, 0.0, 0),
        (0.1, 0.0, 0),
        (0.4, 0.0, 2),
        (0.5, 0.0, 0),
        (0.6, 0.0, 0),
        (0.7, 0.0, 0),
    ]


def test_a_deadline_between_two_steps_of_the_clock_is_ticked_once(virtual):
    """The virtual clock knows microseconds; a third of ten seconds lies between two of them."""

    async def main():
        ticker, stop = Ticker(10.0 / 3.0), Stop()
        return [(await ticker.tick(stop)).t for _ in range(30)]

    assert virtual(main()) == pytest.approx([k * 10.0 / 3.0 for k in range(30)], abs=1e-5)


def test_waiting_ends_at_once_when_stopped(virtual):
    async def main():
        stop = Stop()
        asyncio.get_running_loop().call_later(2.0, stop.set)
        stopped = await stop.wait(10.0)
        return stopped, asyncio.get_running_loop().time()

    stopped, now = virtual(main())
    assert stopped
    assert now < 3.0


def test_all_who_wait_are_woken_and_who_comes_later_does_not_wait(virtual):
    async def main():
        stop, loop = Stop(), asyncio.get_running_loop()
        waiting = [asyncio.create_task(stop.wait(10.0 * k)) for k in (1, 2, 3)]
        cancelled = asyncio.create_task(stop.wait(10.0))
        await asyncio.sleep(1.0)
        cancelled.cancel()
        await asyncio.sleep(10.0)
        stop.set()
        stop.set()
        told = await asyncio.gather(*waiting, cancelled, stop.wait(10.0), return_exceptions=True)
        return told[:3], type(told[3]), told[4], loop.time()

    told, cancelled, late, now = virtual(main())
    assert told == [False, True, True]
    assert cancelled is asyncio.CancelledError
    assert late
    assert now < 12.0
