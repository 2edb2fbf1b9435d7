"""The real-time class: asked for, not permitted, and taken back from a thread that never waits."""

import os
import subprocess
import sys

import pytest

from autotuner.runtime import real_time

linux = pytest.mark.skipif(sys.platform != "linux", reason="the class is of Linux")

SPINNING = """
import os, threading
from autotuner.runtime.real_time import claim, guard

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
def test_a_thread_that_never_waits_is_put_back():
    """Without permission it never was in the class, and ends at once."""
    done = subprocess.run([sys.executable, "-c", SPINNING], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in {"True", "False"}
