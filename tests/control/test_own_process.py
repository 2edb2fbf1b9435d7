"""A loop with a process of its own, over a real wire; PLC, service and judge are processes too."""

import json
import os
import signal
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from autotuner.control.records.lease_record import read_record
from tests.control.processes import PATIENCE_S, REST, full_pipe, lives, loop_process_of, plc_with_plant, spawn, until

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the processes are found in /proc"),
]


QUICK = {"structure": "fopdt", "rule": "simc_pi"}
"""What keeps the analysis short: the wire is judged here."""


@pytest.fixture
def scene(tmp_path):
    """A PLC with a plant, a service that tunes its loop, and a client that looks at the PLC."""

    def start(stack, relay, **streams):
        plc = plc_with_plant(stack, tmp_path, relay=relay)
        service = spawn(stack, "serve", "--json", "--config", plc.config, **streams)
        url = json.loads(service.stdout.readline())["listening"]
        client = stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S))
        return SimpleNamespace(
            service=service,
            client=client,
            tuning=client.post("/v1/loops/TIC-101/tunings", json=QUICK).json()["id"],
            output=plc.output,
            journal=plc.journal,
            again=lambda: spawn(stack, "serve", "--json", "--config", plc.config),
        )

    with ExitStack() as stack:
        yield lambda relay="min_periods = 12", **streams: start(stack, relay, **streams)


def moved(scene):
    return lambda: abs(scene.output() - REST) > 1.0


def at_rest(scene):
    return lambda: abs(scene.output() - REST) < 0.06


def ended(scene):
    told = scene.client.get(f"/v1/tunings/{scene.tuning}").json()
    return told if told["state"] == "ended" else None


def ends_with_the_loop_given_back(scene):
    """End the service as a service manager does."""
    scene.service.terminate()
    assert scene.service.wait(PATIENCE_S) == 0
    assert at_rest(scene)()
    assert scene.journal.interrupted() == []


def test_a_loop_is_tuned(scene):
    scene = scene(relay="min_periods = 3, check = false")
    told = until(lambda: ended(scene))
    assert told["verdict"]["outcome"] == "done"
    assert told["model"]["K"] == pytest.approx(2.0, rel=0.1)
    assert told["restored"] is True
    assert at_rest(scene)()
    kept = read_record(scene.journal.store, told["id"])
    assert len(kept.samples) == told["samples"]
    assert kept.verdict is not None


def test_the_service_gives_back_the_loop_of_a_killed_process(scene):
    scene = scene()
    until(moved(scene))
    os.kill(loop_process_of(scene.service), signal.SIGKILL)
    told = until(lambda: ended(scene))
    assert told["verdict"]["code"] == "process_lost"
    assert told["restored"] is True
    assert at_rest(scene)()
    assert scene.journal.interrupted() == []


def test_the_process_gives_the_loop_of_a_killed_service_back(scene):
    """Nobody starts the service again meanwhile; and when somebody does, there is nothing left to do."""
    scene = scene()
    until(moved(scene))
    scene.service.kill()
    until(at_rest(scene))
    until(lambda: all(kept.restored for kept in scene.journal.interrupted()))  # none, once its lease is released
    again = scene.again()
    again.stdout.readline()
    until(scene.journal.made_good)
    assert at_rest(scene)()
    again.terminate()
    assert again.wait(PATIENCE_S) == 0


@pytest.mark.parametrize("first", ["process", "service"])
def test_sigterm_gives_the_loop_back(scene, first):
    """A service manager sends it to both at once, in any order."""
    scene = scene()
    until(moved(scene))
    loop_process_of(scene.service)
    if first == "process":
        os.kill(loop_process_of(scene.service), signal.SIGTERM)
        assert until(lambda: ended(scene))["verdict"]["code"] == "shutdown"
    ends_with_the_loop_given_back(scene)


def test_sigterm_gives_the_loop_back_while_nobody_reads_the_log(scene):
    with full_pipe() as unread:
        scene = scene(stderr=unread)
        until(moved(scene))
        ends_with_the_loop_given_back(scene)


def test_the_process_ends_with_a_killed_service_while_nobody_reads_the_log(scene):
    with full_pipe() as unread:
        scene = scene(stderr=unread)
        until(moved(scene))
        process = loop_process_of(scene.service)
        scene.service.kill()
        scene.service.wait()
        until(lambda: not lives(process))
        assert at_rest(scene)()
        assert all(kept.restored for kept in scene.journal.interrupted())
