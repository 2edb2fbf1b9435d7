"""A verification killed with -9 over a real wire; PLC, tuner and the judge are separate programs."""

import json
import signal
from contextlib import ExitStack

import httpx
import pytest

from tests.runtime.processes import PATIENCE_S, REST, plc_with_plant, spawn, until

pytestmark = pytest.mark.realtime

AT_REST = 2.0 * REST
QUICK = "min_periods = 3, accuracy = 0.05, check = false"


@pytest.fixture
def plc(tmp_path):
    """A simulated PLC with a controller of its own, in manual, and an independent client that looks at it."""
    with ExitStack() as stack:
        one = plc_with_plant(stack, tmp_path, relay=QUICK, gains=["0.3", "2", "0"])
        one.found = as_it_stands(one)
        yield one


def as_it_stands(plc):
    return plc.gains(), plc.set_point(), plc.output(), bool(plc.auto())


def in_the_step(plc):
    """The set point is off by more than the mean of the PV at rest could be."""
    return lambda: plc.gains() != plc.found[0] and plc.auto() and abs(plc.set_point() - AT_REST) > 1.0


def test_a_killed_service_has_everything_back_with_its_next_start(plc):
    with ExitStack() as stack:
        service = spawn(stack, "serve", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        asked = {"verify": True, "structure": "fopdt"}
        tuning = httpx.post(f"{url}/v1/loops/TIC-101/tunings", json=asked, timeout=PATIENCE_S).json()
        until(in_the_step(plc))
        service.kill()
        service.wait()
        assert as_it_stands(plc) != plc.found
        service = spawn(stack, "serve", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        until(lambda: plc.journal.interrupted() == [])
        assert as_it_stands(plc) == plc.found
        told = httpx.get(f"{url}{tuning['links']['self']}", timeout=PATIENCE_S).json()
        assert told["model"]["K"] == pytest.approx(2.0, rel=0.1)
        assert told["verification"]["verdict"]["code"] == "interrupted"
        assert (told["verification"]["rolled_back"], told["applied"]) == (True, None)
        service.send_signal(signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0


def test_a_killed_command_has_everything_back_with_the_next_one(plc):
    with ExitStack() as stack:
        tuner = spawn(stack, "tune", "--config", plc.config, "--structure", "fopdt", "--verify")
        until(in_the_step(plc))
        tuner.kill()
        tuner.communicate(timeout=PATIENCE_S)
        again = spawn(stack, "tune", "--config", plc.config, "--quiet-s", "1000")
        told = again.stderr.readline()
        assert told.startswith("earlier verification of TIC-101: ")
        assert "the old gains are back; the set point is back at 80" in told
        assert as_it_stands(plc) == plc.found
        again.send_signal(signal.SIGTERM)
        assert again.wait(PATIENCE_S) == 1
