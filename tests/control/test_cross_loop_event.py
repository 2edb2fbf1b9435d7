"""The bell: nothing that was rung for is lost, in whatever event loop one listens."""

import asyncio
import threading

import pytest

from autotuner.control.clock.cross_loop_event import Bell
from tests.control.processes import PATIENCE_S

MANY = 2000


async def collected(bell, news, count):
    """Return what is new until there are `count`."""
    seen = []
    while True:
        rung = bell.listen()
        seen.extend(news[len(seen) :])
        if len(seen) >= count:
            return seen
        await rung.wait()


@pytest.mark.virtual_time
async def test_everybody_is_woken_once_a_ring():
    bell = Bell()
    first, second = bell.listen(), bell.listen()
    assert first is second
    bell.ring()
    assert first.is_set()
    assert not bell.listen().is_set()


@pytest.mark.virtual_time
async def test_nobody_needs_to_listen():
    bell = Bell()
    bell.ring()
    assert not bell.listen().is_set()


async def test_none_is_lost_across_threads():
    """One thread rings, two event loops listen with several listeners each."""
    bell, news, elsewhere = Bell(), [], []

    async def listen():
        return await asyncio.gather(*(collected(bell, news, MANY) for _ in range(3)))

    def ring():
        for number in range(MANY):
            news.append(number)
            bell.ring()

    listener = threading.Thread(target=lambda: elsewhere.extend(asyncio.run(listen())))
    ringer = threading.Thread(target=ring)
    listener.start()
    ringer.start()
    here = await asyncio.wait_for(listen(), PATIENCE_S)
    await asyncio.to_thread(ringer.join)
    await asyncio.to_thread(listener.join)
    assert here == elsewhere == [list(range(MANY))] * 3


def test_a_listener_whose_event_loop_is_closed_is_forgotten():
    bell = Bell()

    async def listen():
        return bell.listen()

    asyncio.run(listen())
    bell.ring()
    assert bell._waiting == {}
