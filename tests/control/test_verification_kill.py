"""A verification killed with -9 over a real wire; PLC, tuner and the judge are separate programs.

The line between tuner and PLC keeps back the answer to the step, and the tuner waits for it while it is killed.
"""

import json
import os
import signal
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from tests.control.processes import PATIENCE_S, REST, Line, children_of, plc_with_plant, spawn, until

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the processes are found in /proc"),
]

AT_REST = 2.0 * REST
SET_POINT = 1
"""Its register."""
QUICK = "min_periods = 3, accuracy = 0.05, check = false"


@pytest.fixture
def plc(tmp_path):
    """A simulated PLC with a controller of its own, in manual, behind a line; an independent client looks at it."""
    with ExitStack() as stack:
        one = plc_with_plant(stack, tmp_path, relay=QUICK, gains=["0.3", "2", "0"])
        one.found = as_it_stands(one)
        one.line = Line(one.port, is_the_step, arrives=True)
        stack.callback(one.line.close)
        one.line.lead(one)
        yield one


def as_it_stands(plc):
    return plc.gains(), plc.set_point(), plc.output(), bool(plc.auto())


def is_the_step(address, words):
    """The set point goes off by more than the mean of the PV at rest could be."""
    return address == SET_POINT and abs(0.1 * int.from_bytes(words[:2], "big") - AT_REST) > 1.0


def in_the_step(plc):
    """Wait until the PLC makes the step, with the new gains."""
    assert plc.line.kept_back.wait(PATIENCE_S)
    assert abs(plc.set_point() - AT_REST) > 1.0
    assert plc.gains() != plc.found[0]
    assert plc.auto()
    plc.line.mend()


def verifying(stack, plc):
    """Start a service that verifies gains; return it in the middle of the step, with the tuning as it is told then."""
    service = spawn(stack, "serve", "--json", "--config", plc.config)
    url = json.loads(service.stdout.readline())["listening"]
    asked = {"verify": True, "structure": "fopdt", "rule": "simc_pi"}
    tuning = httpx.post(f"{url}/v1/loops/TIC-101/tunings", json=asked, timeout=PATIENCE_S).json()
    in_the_step(plc)
    return service, httpx.get(f"{url}{tuning['links']['self']}", timeout=PATIENCE_S).json()


def told_by_the_next_start(stack, plc, tuning):
    """What the next service tells of a tuning, once nothing of it is interrupted any more."""
    service = spawn(stack, "serve", "--json", "--config", plc.config)
    url = json.loads(service.stdout.readline())["listening"]
    until(lambda: plc.journal.interrupted() == [])
    told = httpx.get(f"{url}{tuning['links']['self']}", timeout=PATIENCE_S).json()
    service.send_signal(signal.SIGTERM)
    assert service.wait(PATIENCE_S) == 0
    return told


def is_told(told, tuning):
    assert told["model"] == tuning["model"] is not None
    assert told["verification"]["verdict"]["code"] == "interrupted"
    assert "the old gains are restored; the set point is restored to 80" in told["verification"]["verdict"]["message"]
    assert (told["verification"]["rolled_back"], told["applied"]) == (True, None)


def test_a_killed_service_has_everything_back_before_anybody_starts_it(plc):
    with ExitStack() as stack:
        service, tuning = verifying(stack, plc)
        service.kill()
        until(lambda: as_it_stands(plc) == plc.found)
        is_told(told_by_the_next_start(stack, plc, tuning), tuning)
        assert as_it_stands(plc) == plc.found


def test_where_everything_is_killed_the_next_start_has_it_back(plc):
    with ExitStack() as stack:
        service, tuning = verifying(stack, plc)
        for number in [service.pid, *children_of(service)]:
            os.kill(number, signal.SIGKILL)
        service.wait()
        assert as_it_stands(plc) != plc.found
        is_told(told_by_the_next_start(stack, plc, tuning), tuning)
        assert as_it_stands(plc) == plc.found


def test_a_killed_command_has_everything_back_and_the_next_one_tells(plc):
    with ExitStack() as stack:
        tuner = spawn(stack, "tune", "--config", plc.config, "--structure", "fopdt", "--rule", "simc_pi", "--verify")
        in_the_step(plc)
        tuner.kill()
        until(lambda: as_it_stands(plc) == plc.found)
        tuner.communicate(timeout=PATIENCE_S)
        again = spawn(stack, "tune", "--config", plc.config, "--quiet-s", "1000")
        told = again.stderr.readline()
        assert told.startswith("autotuner: earlier verification of TIC-101: ")
        assert "the old gains are restored; the set point is restored to 80" in told
        assert as_it_stands(plc) == plc.found
        again.send_signal(signal.SIGTERM)
        assert again.wait(PATIENCE_S) == 1


def test_the_process_that_stands_by_leaves_a_living_owner_alone_and_goes_with_it(plc):
    """Signals of a service manager reach it too: what is to be done is done once, by its owner."""
    with ExitStack() as stack:
        service, _ = verifying(stack, plc)
        others = children_of(service)
        for number in [*others, service.pid]:
            os.kill(number, signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0
        assert as_it_stands(plc) == plc.found
        assert plc.journal.interrupted() == []
        until(lambda: not any(Path(f"/proc/{number}").exists() for number in others))


def test_the_set_point_of_a_killed_run_is_back_by_itself(tmp_path):
    """Killed on the way to the first point: its controller, left alone, goes back to where it was."""
    with ExitStack() as stack:
        plc = plc_with_plant(stack, tmp_path, auto=True, gains=["0.3", "2", "0"])
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        started = httpx.post(f"{url}/v1/loops/TIC-101/schedules", json={"set_points": [70, 90]}, timeout=PATIENCE_S)
        until(lambda: plc.set_point() == 70.0)
        service.kill()
        until(lambda: plc.set_point() == 80.0)
        (kept,) = until(lambda: [kept for kept in plc.journal.interrupted() if kept.restored])
        assert plc.auto()
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        until(lambda: plc.journal.interrupted() == [])
        told = httpx.get(f"{url}{started.headers['location']}", timeout=PATIENCE_S).json()
        assert (told["id"], told["verdict"]["code"], told["set_points"]) == (kept.tuning, "interrupted", [70, 90])
        service.send_signal(signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0
