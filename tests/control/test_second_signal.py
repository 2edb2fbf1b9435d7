"""Asked twice for the end, nobody waits for a dead device: in virtual time, and command and service as processes."""

import asyncio
import json
import signal
import socket
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from autotuner.control.clock.ticker import Ticker
from autotuner.control.devices.retrying import persistently
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Kind
from autotuner.core.verdict import aborted
from autotuner.errors import LinkError
from autotuner.ports import OUTPUT
from tests.control.processes import ANSWER_S, PATIENCE_S, REST, Line, plc_with_plant, spawn, until

STOP = aborted("signal", "stopped by SIGTERM", "Start it again when wanted.")


@pytest.fixture
def dying(rig, virtual, tmp_path):
    """Return a function that has a line die in the relay, the tuning aborted, and the end asked for again."""

    def run(again_s):
        async def main():
            one = rig()
            journal = Journal(tmp_path / "data", in_place=True)
            one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
            work = asyncio.create_task(one.conduct())
            await one.moved()

            async def dead(_call, _number, _names):
                raise LinkError("the line is dead", remedy="Plug it in.")

            one.backend.script = dead
            one.tuning.abort(STOP)
            if again_s is not None:
                await asyncio.sleep(again_s)
                wait_no_more()
            asked_s = asyncio.get_running_loop().time()
            await work
            return one.tuning, asyncio.get_running_loop().time() - asked_s, journal

        return virtual(main())

    return run


def last_unknown(tuning):
    return [event.message for event in tuning.events if event.type == "output_unknown"][-1]


def test_asked_again_it_waits_no_more_and_says_where_the_output_is_left(dying, caplog):
    tuning, waited_s, journal = dying(20.0)
    assert waited_s < 0.01
    written = tuning.samples[-1].output
    told = f"the end was requested again: it is left as it is; {written:g} was written last, 40 is where it was to go"
    assert last_unknown(tuning).startswith(told)
    assert told in caplog.text
    assert "lease T1 stays open" in caplog.text
    assert tuning.verdict.code == "output_unknown"
    assert "stopped by SIGTERM" in tuning.verdict.message
    (kept,) = journal.left()
    assert kept.left == STOP


def test_not_asked_again_it_waits_to_its_limit_and_says_so(dying):
    tuning, waited_s, _ = dying(None)
    assert waited_s >= 600.0
    assert last_unknown(tuning).startswith("600 s are over: it is left as it is; ")


def test_a_device_that_answers_is_given_back_to_the_end_however_slowly(rig, virtual):
    """A limit of the slew makes a way of seconds, which a second signal does not cut in the middle."""
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 2.0}

    async def main():
        one = rig(limits=limits)
        work = asyncio.create_task(one.conduct())
        await one.moved()
        one.tuning.abort(STOP)
        await asyncio.sleep(0.5)
        wait_no_more()
        await work
        return one.tuning.verdict, (await one.now(OUTPUT))[OUTPUT]

    assert virtual(main()) == (STOP, REST)


def test_a_try_that_hangs_is_given_up(virtual):
    """Behind a first one that has failed: a driver that waits long for its answer."""
    tries = []

    async def attempt():
        tries.append(asyncio.get_running_loop().time())
        await asyncio.sleep(0.0 if len(tries) == 1 else 50.0)
        raise LinkError("the line is dead", remedy="Plug it in.")

    async def main():
        work = asyncio.create_task(persistently(attempt, Ticker(0.1), lambda _: None, 600.0))
        await asyncio.sleep(10.0)
        wait_no_more()
        asked_s = asyncio.get_running_loop().time()
        return await work, asyncio.get_running_loop().time() - asked_s

    assert virtual(main()) == (None, 0.0)
    assert len(tries) == 2


def real(test):
    """Mark a test with processes on the wall clock, whose signals are looked up in /proc."""
    there = Path("/proc/self/status").is_file()
    return pytest.mark.realtime(pytest.mark.skipif(not there, reason="signals are looked up in /proc")(test))


@pytest.fixture
def plc(tmp_path):
    with ExitStack() as stack:
        yield plc_with_plant(stack, tmp_path)


def ended_by_signals(process):
    """Ask for the end twice, the second time once the first has been taken: two at once would count as one."""
    for _ in range(2):
        process.send_signal(signal.SIGTERM)
        until(lambda: "ShdPnd:\t0000000000000000" in Path(f"/proc/{process.pid}/status").read_text())
    return process.communicate(timeout=PATIENCE_S)[1]


def dead_in_the_relay(plc):
    """The PLC is switched off with the relay under way."""
    until(lambda: abs(plc.output() - REST) > 1.0)
    plc.process.kill()
    plc.process.wait()


@real
def test_a_command_with_a_dead_device_ends_at_the_second_signal(plc):
    with ExitStack() as stack:
        tuner = spawn(stack, "tune", "--config", plc.config, "--json")
        dead_in_the_relay(plc)
        told = ended_by_signals(tuner)
        assert tuner.returncode == 1
        left_in_the_dark(plc, told)


@real
def test_a_service_with_a_dead_device_ends_at_the_second_signal(plc):
    """The loop has a process of its own, which is told."""
    with ExitStack() as stack:
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        httpx.post(f"{url}/v1/loops/TIC-101/tunings", timeout=PATIENCE_S).raise_for_status()
        dead_in_the_relay(plc)
        told = ended_by_signals(service)
        assert service.returncode == 0
        assert "devices that do not answer are left to the next start" in told
        left_in_the_dark(plc, told)


def left_in_the_dark(plc, told):
    (kept,) = plc.journal.interrupted()
    assert "the end was requested again: it is left as it is; " in told
    assert "was written last, 40 is where it was to go back to" in told
    assert f"lease {kept.name} stays open" in told
    assert kept.left is not None
    assert not kept.restored


TI = 12
"""Register of the second gain."""
APPLY = ("apply", "TIC-101", "--gains", "1.5,4,0.6")


@pytest.fixture
def controller(tmp_path):
    """A PLC with a controller of its own, behind a line that keeps its second gain back."""
    with ExitStack() as stack:
        relay = "min_periods = 3, accuracy = 0.05, check = false"
        one = plc_with_plant(stack, tmp_path, relay=relay, gains=["0.3", "2", "0"])
        one.line = Line(one.port, lambda address, _words: address == TI)
        stack.callback(one.line.close)
        one.line.lead(one)
        config = Path(one.config)
        config.write_text(config.read_text().replace(f"timeout_s = {ANSWER_S}", "timeout_s = 1.0"))
        yield one


def gone(plc):
    plc.process.kill()
    plc.process.wait()


@real
def test_an_apply_whose_device_dies_half_way_ends_at_the_second_signal(controller):
    with ExitStack() as stack:
        command = spawn(stack, *APPLY, "--config", controller.config)
        assert controller.line.kept_back.wait(PATIENCE_S)
        gone(controller)
        told = ended_by_signals(command)
        assert command.returncode == 1
        assert (
            "the gains in the device are unknown. Roll back when the device answers again, or set them by hand" in told
        )
        (kept,) = controller.journal.interrupted()
        assert f"lease {kept.name} stays open" in told
        assert "the gains in the device are unknown" in kept.left.message


@real
def test_a_verification_whose_device_dies_in_its_step_ends_at_the_second_signal(controller):
    with ExitStack() as stack:
        controller.line.mend()
        words = ("--structure", "fopdt", "--rule", "simc_pi", "--verify", "--json")
        command = spawn(stack, "tune", "TIC-101", "--config", controller.config, *words)
        until(lambda: controller.auto() and abs(controller.set_point() - 2.0 * REST) > 1.0)
        gone(controller)
        told = ended_by_signals(command)
        assert command.returncode == 1
        (kept,) = controller.journal.interrupted()
        assert f"lease {kept.name} stays open" in told
        assert kept.kind is Kind.VERIFICATION
        assert not kept.restored


@real
def test_a_command_that_is_stopped_before_it_has_written_says_so(controller):
    """Its device takes connections and says nothing."""
    with ExitStack() as stack, socket.create_server(("127.0.0.1", 0)) as silent:
        text = Path(controller.config).read_text().replace("timeout_s = 1.0", "timeout_s = 50.0")
        port = silent.getsockname()[1]
        Path(controller.config).write_text(text.replace(f"port = {controller.line.port}", f"port = {port}"))
        command = spawn(stack, *APPLY, "--config", controller.config)
        line = stack.enter_context(silent.accept()[0])
        assert line.recv(100)
        command.send_signal(signal.SIGTERM)
        told = command.communicate(timeout=PATIENCE_S)
        assert told == ("", "autotuner: stopped by SIGTERM before anything was written. Start it again when wanted.\n")
        assert command.returncode == 1
        assert controller.journal.interrupted() == []
