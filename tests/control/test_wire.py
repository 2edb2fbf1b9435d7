"""The wire between front and loop process: its last message is waited for, but not for ever."""

import asyncio
import pickle
import socket
import sys

import pytest

from autotuner.control.operations import messages
from autotuner.control.operations.messages import Alive, Done, wire_over

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform == "win32", reason="a process can be given no socket there"),
]
LARGE = Done(bytes(10_000_000))


async def test_an_end_that_closes_waits_until_the_last_message_is_taken():
    ours, theirs = [await wire_over(end) for end in socket.socketpair()]
    theirs.send(LARGE)
    closing = asyncio.create_task(theirs.close())
    await asyncio.sleep(0.1)
    assert not closing.done()
    assert await ours.receive() == LARGE
    await closing
    assert await ours.receive() is None
    await ours.close()


async def test_it_does_not_wait_for_one_that_takes_nothing(monkeypatch):
    monkeypatch.setattr(messages, "TAKEN_S", 0.2)
    ours, theirs = socket.socketpair()
    with ours:
        wire = await wire_over(theirs)
        wire.send(LARGE)
        begun_s = asyncio.get_running_loop().time()
        await wire.close()
        assert asyncio.get_running_loop().time() - begun_s >= 0.2


async def test_what_was_sent_before_an_end_closed_is_received_although_a_message_to_it_is_lost():
    """As a front finds it that was stopped: its process has said how it ended, and is gone."""
    ours, theirs = socket.socketpair()
    wire = await wire_over(ours)
    with theirs:
        theirs.sendall(framed(Done("how it ended")))
    wire.send(Alive())
    assert await wire.receive() == Done("how it ended")
    assert await wire.receive() is None
    await wire.close()


def framed(message):
    data = pickle.dumps(message)
    return len(data).to_bytes(messages.HEADER_BYTES, "big") + data
