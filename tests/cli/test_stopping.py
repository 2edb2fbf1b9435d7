"""What ends a command: the signals that nobody told it to ignore."""

import asyncio
import os
import signal

import pytest

from autotuner.commands.terminal.stopping import stoppable
from autotuner.stopped_by import stopped_by


@pytest.mark.parametrize(("handler", "ended_by"), [(signal.SIG_DFL, [signal.SIGHUP]), (signal.SIG_IGN, [])])
def test_a_closed_terminal_ends_a_command_unless_it_was_told_to_outlive_it(closes, handler, ended_by):
    closes(handler)
    asked = asyncio.Queue()

    async def closed_terminal():
        for number in (signal.SIGHUP, signal.SIGTERM):
            os.kill(os.getpid(), number)
        return [await asked.get() for _ in range(len(ended_by) + 1)]

    heard = asyncio.run(stoppable(closed_terminal(), asked.put_nowait))
    assert sorted(heard) == sorted([*ended_by, signal.SIGTERM])
    assert asked.empty()


def test_a_program_under_nohup_is_ended_by_all_but_its_terminal(closes):
    closes(signal.SIG_DFL)
    all_of_them = stopped_by()
    closes(signal.SIG_IGN)
    assert [one for one in all_of_them if one not in stopped_by()] == [signal.SIGHUP]
