"""`autotuner apply`, and the same over REST, killed with -9 between two registers, over a real wire.

The line between program and PLC keeps the second gain back, and the program waits for its answer while it is killed.
"""

import json
import os
import signal
import struct
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from tests.control.processes import PATIENCE_S, Line, children_of, kill_all, plc_with_plant, spawn, until

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the processes are found in /proc"),
]

TI = 12
"""Register of the second gain."""
QUICK = "min_periods = 3, accuracy = 0.05, check = false"
GAINS = "1.5,4,0.6"
BACK = "the program was killed during the change of gains; the old gains are restored"


@pytest.fixture
def plc(tmp_path):
    """A simulated PLC with a controller of its own, behind a line, and an independent client that looks at it."""
    with ExitStack() as stack:
        one = plc_with_plant(stack, tmp_path, relay=QUICK, gains=["0.3", "2", "0"])
        one.line = Line(one.port, lambda address, _words: address == TI)
        stack.callback(one.line.close)
        one.line.lead(one)
        one.found = one.gains()
        yield one


def in_between(plc):
    """Wait until the PLC holds the first new gain and the old others."""
    assert plc.line.kept_back.wait(PATIENCE_S)
    until(lambda: plc.gains()[:2] != plc.found[:2])
    assert plc.gains()[2:] == plc.found[2:]
    plc.line.mend()


def applying(stack, plc):
    command = spawn(stack, "apply", "TIC-101", "--config", plc.config, "--gains", GAINS)
    in_between(plc)
    return command


def test_a_killed_apply_has_the_old_gains_back_before_anybody_starts_anything(plc):
    with ExitStack() as stack:
        command = applying(stack, plc)
        command.kill()
        until(lambda: plc.gains() == plc.found)
        _, told = command.communicate(timeout=PATIENCE_S)
        assert f"gains of loop TIC-101: {BACK}" in told
        again = spawn(stack, "apply", "TIC-101", "--config", plc.config, "--gains", GAINS)
        _, told = again.communicate(timeout=PATIENCE_S)
        assert again.returncode == 0, told
        assert told == f"autotuner: earlier gains of TIC-101: {BACK}\n"
        assert plc.gains() != plc.found
        assert plc.journal.interrupted() == []
        back = spawn(stack, "rollback", "TIC-101", "--config", plc.config)
        _, told = back.communicate(timeout=PATIENCE_S)
        assert (back.returncode, told) == (0, "")
        assert plc.gains() == plc.found


@pytest.mark.parametrize("again", ["serve", "apply"])
def test_where_everything_is_killed_the_next_start_has_them_back(plc, again):
    with ExitStack() as stack:
        kill_all(applying(stack, plc))
        assert plc.gains() != plc.found
        told = next_start(stack, plc, again)
        assert BACK in told
        assert plc.gains() == plc.found
        assert plc.journal.interrupted() == []


def next_start(stack, plc, word):
    """What is told on standard error by the next program that gives the loop back."""
    if word == "apply":  # of the gains that are there: the PLC is to end as it was found
        command = spawn(stack, "apply", "TIC-101", "--config", plc.config, "--gains", "0.3,2")
    else:
        command = spawn(stack, "serve", "--json", "--config", plc.config)
        command.stdout.readline()
        until(lambda: plc.journal.interrupted() == [])
        command.send_signal(signal.SIGTERM)
    _, told = command.communicate(timeout=PATIENCE_S)
    assert command.returncode == 0, told
    return told


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_command_comes_to_its_end_and_tells_it(plc, number):
    """Ctrl-C reaches the process that stands by too: what is to be done is done once, by its owner."""
    with ExitStack() as stack:
        command = applying(stack, plc)
        for process in [*children_of(command), command.pid]:
            os.kill(process, number)
        plc.line.let_go()
        told = command.communicate(timeout=PATIENCE_S)
        assert (command.returncode, told[1]) == (0, "")
        assert "written and read back" in told[0]
        assert plc.gains() == list(struct.unpack(">6H", struct.pack(">3f", 1.5, 4.0, 0.6)))
        assert plc.journal.interrupted() == []


def test_a_stopped_rollback_comes_to_its_end(plc):
    with ExitStack() as stack:
        plc.line.mend()
        first = spawn(stack, "apply", "TIC-101", "--config", plc.config, "--gains", GAINS)
        assert first.wait(PATIENCE_S) == 0
        plc.line.keep_back()
        command = spawn(stack, "rollback", "TIC-101", "--config", plc.config)
        assert plc.line.kept_back.wait(PATIENCE_S)
        command.send_signal(signal.SIGTERM)
        plc.line.mend()
        plc.line.let_go()
        told = command.communicate(timeout=PATIENCE_S)
        assert (command.returncode, told[1]) == (0, "")
        assert plc.gains() == plc.found
        assert plc.journal.interrupted() == []


@pytest.mark.parametrize("everything", [False, True], ids=["the service", "all"])
def test_a_service_killed_between_two_registers(plc, everything):
    with ExitStack() as stack:
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        client = stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S))
        asked = {"structure": "fopdt", "rule": "simc_pi", "apply": True}
        links = client.post("/v1/loops/TIC-101/tunings", json=asked).json()["links"]
        in_between(plc)
        if everything:
            kill_all(service)
            assert plc.gains() != plc.found
        else:
            service.kill()
            until(lambda: plc.gains() == plc.found)
        again = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(again.stdout.readline())["listening"]
        until(lambda: plc.journal.interrupted() == [])
        assert plc.gains() == plc.found
        told = httpx.get(f"{url}{links['self']}", timeout=PATIENCE_S).json()
        assert (told["verdict"]["outcome"], told["applied"]) == ("done", None)
        until(lambda: "gains recovered after a kill" in httpx.get(f"{url}/v1/audit", timeout=PATIENCE_S).text)
        again.send_signal(signal.SIGTERM)
        assert again.wait(PATIENCE_S) == 0
