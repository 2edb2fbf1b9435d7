"""A process that gives a loop back when the program that moves it is gone.

    owner -- socket --> guardian
    a byte: all is back as it should be         the end without one: the loop is given back from its journals, at once

A verification, a change of gains and a run over operating points are driven by the service itself: they have no
deadlines that a request could miss; a tuning from the shell is driven by the command. What they lack against a process
of their own is this one.

Rules of this file:

1. It does nothing to the device while its owner lives, and it knows no way of its own: it does what the next start does
   (`autotuner.application.recovery`), tells standard error, and leaves all other telling to that.
2. The device's lock goes with the owner, and with the process of the loop that gives an output back before: that is
   waited for.
3. It ends with a word of its owner, or when the loop is back. Signals are for the owner: it sees to the rest.
4. Without one, everything goes on: the journal is there.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import signal
import socket
import sys
from typing import TYPE_CHECKING

from autotuner.application.gain_service import unguarded
from autotuner.control.event_loop import fine_event_loop
from autotuner.control.journal import Journal
from autotuner.control.plugins import make_backend
from autotuner.control.real_time import leave
from autotuner.control.retrying import to_its_end
from autotuner.errors import AutotunerError, LoopBusyError
from autotuner.stopped_by import stopped_by, suspended_by

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from multiprocessing.context import SpawnProcess
    from pathlib import Path

    from autotuner.application.gain_service import Guard
    from autotuner.configuration import LoopTable
    from autotuner.ports import Backend

READY_S = 30.0
"""Longest wait for a guardian to be there, s."""
LEAVING_S = 10.0
"""Longest wait for one that is not needed any more, s."""
AGAIN_S = 0.05
"""Time between two looks whether the device is free, s."""
HERE, DONE = b"h", b"d"

_log = logging.getLogger(__name__)


def guard_here(*, alone: bool = False) -> Guard:
    """Return how a process is had to stand by: none where there are no others, as where none can be given a socket."""
    return unguarded if alone or sys.platform == "win32" else guarded


@contextlib.asynccontextmanager
async def guarded(name: str, loop: LoopTable, folder: Path) -> AsyncIterator[None]:
    """Have a process stand by until the block has ended, for what it moves on a loop.

    Parameters
    ----------
    name : str
        The loop's name.
    loop : LoopTable
        The loop.
    folder : Path
        The data directory.
    """
    ours, theirs = socket.socketpair()
    process: SpawnProcess | None = None
    try:
        process = await _begun(name, loop, folder, ours, theirs)
        yield
    finally:
        with contextlib.suppress(OSError):
            ours.sendall(DONE)  # whatever is left to do: who lives does it
        ours.close()
        if process is not None:
            await to_its_end(asyncio.to_thread(_leave, process))


async def _begun(
    name: str, loop: LoopTable, folder: Path, ours: socket.socket, theirs: socket.socket
) -> SpawnProcess | None:
    """Start a guardian; return it when it stands by, None where there is none."""
    ours.setblocking(False)  # noqa: FBT003 - the name says it
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=stand_by, args=(name, loop, folder, theirs), name=f"guardian-{name}")
    try:
        await asyncio.to_thread(process.start)
    except OSError as error:
        _log.warning("no process stands by for loop %s: %s", name, error)
        return None
    finally:
        theirs.close()
    if not await _is_there(ours):
        _log.warning("the process that should stand by for loop %s does not answer", name)
    return process


async def _is_there(ours: socket.socket) -> bool:
    try:
        async with asyncio.timeout(READY_S):
            return await asyncio.get_running_loop().sock_recv(ours, len(HERE)) == HERE
    except OSError:  # a timeout is one too
        return False


def _leave(process: SpawnProcess) -> None:
    process.join(LEAVING_S)
    if process.is_alive():
        process.kill()
        process.join()
    process.close()


def stand_by(name: str, loop: LoopTable, folder: Path, end: socket.socket) -> None:
    """Be the guardian of a loop, at one end of a pair of sockets."""
    from autotuner.application.recovery import recover_first  # noqa: F401, PLC0415 - loaded before it is needed

    leave()
    for number in (*stopped_by(), *suspended_by()):  # they reach all at once, and the way back is the owner's
        signal.signal(number, signal.SIG_IGN)
    backend = make_backend(loop.driver, loop.device, f"loops.{name}")
    with end, contextlib.suppress(OSError):
        end.sendall(HERE)
        if end.recv(len(DONE)) == DONE:
            return
    with asyncio.Runner(loop_factory=fine_event_loop) as runner:
        runner.run(give_back(name, loop, backend, Journal(folder)))


async def give_back(name: str, loop: LoopTable, backend: Backend, journal: Journal) -> None:
    """Give a loop back as soon as nobody moves it any more; where that fails, the next start tries again."""
    from autotuner.application.recovery import recover_first  # noqa: PLC0415 - it needs what needs this

    while left := journal.left(name):
        while any(map(journal.is_held, left)):  # noqa: ASYNC110 - another program sets no event
            await asyncio.sleep(AGAIN_S)
        try:
            for kept, shown in await recover_first(name, loop, backend, journal, to_be_told=True):
                if shown.verdict is not None:
                    _log.warning("%s of loop %s: %s", kept.kind, name, shown.verdict.message)
        except LoopBusyError:  # somebody has begun to do it
            continue
        except AutotunerError as error:
            _log.error("loop %s could not be given back: %s", name, error)
        return
