"""A tuning killed with -9 over a real wire: PLC, tuner and the judge that looks at the PLC are separate programs."""

import json
import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from pyModbusTCP.client import ModbusClient

from autotuner.configuration import load_configuration
from tests.control.processes import PATIENCE_S, REST, kill_all, plc_with_plant, spawn, until

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the processes are found in /proc"),
]


@pytest.fixture
def plant(tmp_path):
    """A simulated PLC in a process of its own, and an independent client that looks at it."""
    with ExitStack() as stack:
        yield lambda **keys: plc_with_plant(stack, tmp_path, **keys)


@pytest.mark.parametrize(
    ("after_s", "auto", "again"), [(0.0, False, "serve"), (0.37, True, "tune"), (1.13, True, "serve")]
)
def test_the_next_start_gives_the_loop_back(plant, after_s, auto, again):
    """Killed with all its processes in the relay; then the program is started again and the PLC is looked at."""
    with ExitStack() as stack:
        plc = plant(auto=auto)
        tuner = spawn(stack, "tune", "--config", plc.config)
        until(lambda: abs(plc.output() - REST) > 1.0 or tuner.poll() is not None)
        time.sleep(after_s)  # noqa: TID251 - the moment of the kill
        kill_all(tuner)
        tuner.communicate(timeout=PATIENCE_S)
        assert not plc.auto()
        (kept,) = plc.journal.interrupted()
        assert min(abs(plc.output() - output) for output in kept.commanded) < 0.06
        assert kept.before.auto == float(auto)
        released(stack, plc, again)
        (kept,) = plc.journal.made_good()
        assert kept.verdict.code == "interrupted"
        assert min(abs(kept.samples[-1].output - output) for output in kept.commanded) < 0.06


@pytest.mark.parametrize("auto", [False, True], ids=["manual", "auto"])
def test_a_killed_command_leaves_no_relay_behind(plant, auto):
    """Nobody starts anything: the process that stands by gives the loop back, and the next start tells it once."""
    with ExitStack() as stack:
        plc = plant(auto=auto)
        tuner = spawn(stack, "tune", "--config", plc.config)
        until(lambda: abs(plc.output() - REST) > 1.0)
        tuner.kill()
        until(lambda: plc.output() == pytest.approx(REST, abs=0.06) and plc.auto() == auto)
        _, told = tuner.communicate(timeout=PATIENCE_S)
        was = "the program was killed during the tuning; "
        ways = ("the output is restored to 40", "the process of the loop had restored it")
        back = next(was + way for way in ways if f"tuning of loop TIC-101: {was}{way}" in told)
        (kept,) = plc.journal.interrupted()
        assert kept.restored
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        until(plc.journal.made_good)
        told = httpx.get(f"{url}/v1/tunings/{kept.tuning}", timeout=PATIENCE_S).json()
        assert (told["verdict"]["code"], told["verdict"]["message"], told["restored"]) == ("interrupted", back, True)
        service.send_signal(signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0


def test_signals_leave_the_way_back_to_the_command(plant):
    """Ctrl-C reaches the process that stands by too: the command gives the loop back, and ends with its own verdict."""
    with ExitStack() as stack:
        plc = plant(auto=False)
        tuner = spawn(stack, "tune", "--config", plc.config, "--json", start_new_session=True)
        until(lambda: abs(plc.output() - REST) > 1.0)
        os.killpg(tuner.pid, signal.SIGINT)
        out, _ = tuner.communicate(timeout=PATIENCE_S)
        assert json.loads(out)["verdict"]["code"] == "signal"
        assert plc.output() == pytest.approx(REST, abs=0.06)
        assert plc.journal.interrupted() == []


def released(stack, plc, again):
    """Start the program again; return once the PLC stands as it was found."""
    if again == "serve":
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        until(plc.journal.made_good)
        stands_as_found(plc)
        service.send_signal(signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0
        return
    tuner = spawn(stack, "tune", "--config", plc.config, "--quiet-s", "1000")
    assert "restored to 40" in tuner.stderr.readline()
    stands_as_found(plc)
    tuner.send_signal(signal.SIGTERM)
    assert tuner.wait(PATIENCE_S) == 1


def stands_as_found(plc):
    """The new tuning of a loop in auto takes it to manual at once, at the same output."""
    assert plc.output() == pytest.approx(REST, abs=0.06)
    (kept,) = plc.journal.made_good()
    assert plc.auto() == bool(kept.before.auto) or len(plc.journal.interrupted()) == 1


def moved(kept):
    """Whether the last sample was taken under another output than the one found."""
    return bool(kept.samples) and abs(kept.samples[-1].output - REST) > 1.0


def test_the_recording_is_there_up_to_the_last_moment(plant):
    """What the journal holds at the kill is what the tuner had shown: no sample older than that is missing."""
    with ExitStack() as stack:
        plc = plant(auto=False)
        tuner = spawn(stack, "tune", "--config", plc.config)
        seen = until(lambda: next(filter(moved, plc.journal.interrupted()), None))
        tuner.kill()
        tuner.wait()
        (kept,) = plc.journal.interrupted()
        assert len(kept.samples) >= len(seen.samples)
        assert kept.samples[: len(seen.samples)] == seen.samples or kept.samples[0].t == seen.samples[0].t
        assert moved(kept)


def test_two_tuners_do_not_move_one_device(plant):
    with ExitStack() as stack:
        plc = plant(auto=False)
        first = spawn(stack, "tune", "--config", plc.config, "--quiet-s", "1000")
        until(lambda: plc.journal.interrupted() and plc.journal.interrupted()[0].before)
        second = spawn(stack, "tune", "--config", plc.config)
        _, told = second.communicate(timeout=PATIENCE_S)
        assert second.returncode == 1
        assert "is held by tuning" in told
        first.send_signal(signal.SIGTERM)
        assert first.wait(PATIENCE_S) == 1


def test_an_operator_who_took_over_after_the_kill_is_left_alone(plant):
    with ExitStack() as stack:
        plc = plant(auto=False)
        tuner = spawn(stack, "tune", "--config", plc.config)
        until(lambda: abs(plc.output() - REST) > 1.0)
        kill_all(tuner)
        port = load_configuration(Path(plc.config)).loop("TIC-101").device["port"]
        operator = ModbusClient(host="127.0.0.1", port=port, auto_open=True)
        operator.write_single_register(0, 123)
        operator.close()
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        until(plc.journal.made_good)
        assert plc.output() == 12.3
        assert "not changed" in plc.journal.made_good()[0].verdict.message
        os.kill(service.pid, signal.SIGTERM)
        service.wait(PATIENCE_S)
