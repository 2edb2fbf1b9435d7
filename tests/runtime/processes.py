"""Programs of ours as processes, and waiting for what they do."""

import subprocess
import sys
import time

PATIENCE_S = 60.0
"""Longest wait for a process to do what it must; nothing is asserted of how long it took."""


def spawn(stack, *words, **keys):
    """Start `autotuner ...`; it is killed at the end of the test if it still lives."""
    process = subprocess.Popen(
        [sys.executable, "-m", "autotuner", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **keys
    )
    stack.callback(process.communicate)
    stack.callback(process.kill)
    return process


def until(condition):
    """Wait for what another process does."""
    deadline = time.monotonic() + PATIENCE_S  # noqa: TID251 - other processes live on the wall clock
    while not (seen := condition()):
        assert time.monotonic() < deadline, "it did not happen"  # noqa: TID251
        time.sleep(0.005)  # noqa: TID251
    return seen
