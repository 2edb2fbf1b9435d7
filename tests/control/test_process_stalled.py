"""A program that was paused in the middle of a tuning says so, and not that the sensor was lost; the loop is back."""

import asyncio
import json
import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from autotuner.control.clock import ticker
from autotuner.core.experiment.settings import Limits
from autotuner.core.safety.supervisor import SafetySettings, Supervisor
from autotuner.errors import DeviceTimeoutError
from autotuner.ports import OUTPUT
from tests.control.processes import PATIENCE_S, REST, loop_process_of, plc_with_plant, spawn, until

SILENT = DeviceTimeoutError("the device did not answer", remedy="Check the link.")


def pause(seconds):
    """Let time pass in which nothing of this program runs: the event loop's clock goes on."""
    asyncio.get_running_loop()._selector.clock.advance(seconds)


def conducted(virtual, rig, script=None, paused=None, **keys):
    """Conduct a tuning over a device that does what a script says, paused between two samples at some moment."""

    async def main():
        one = rig(script, **keys) if script else rig(**keys)
        work = asyncio.create_task(one.conduct())
        if paused is not None:
            await asyncio.sleep(20.03)
            paused()
        verdict = await work
        return one, verdict, (await one.now(OUTPUT))[OUTPUT]

    return virtual(main())


def is_told(verdict, seconds):
    assert (verdict.code, verdict.outcome) == ("process_stalled", "aborted")
    told = float(verdict.message.partition("stood still for ")[2].split()[0])
    assert told == pytest.approx(seconds, abs=0.3)
    assert "was paused, or the computer slept" in verdict.message
    assert verdict.remedy.startswith("Keep the computer awake")


def test_paused_between_two_samples(rig, virtual):
    one, verdict, output = conducted(virtual, rig, paused=lambda: pause(30.0))
    is_told(verdict, 30.0)
    assert output == REST
    assert one.tuning.controller.restored


@pytest.mark.parametrize("call", ["read", "write"])
@pytest.mark.parametrize("answered", [True, False], ids=["answered", "timed out"])
def test_paused_within_a_call(rig, virtual, call, answered):
    """The answer is there when the program goes on, or the driver has given it up."""

    async def script(now, _number, _names):
        if now == call and not script.done and asyncio.get_running_loop().time() > 20.0:
            script.done = True
            asyncio.get_running_loop().call_later(0.01, pause, 30.0)
            await asyncio.sleep(0.02 if answered else 0.5)
            if not answered:
                raise SILENT

    script.done = False
    one, verdict, output = conducted(virtual, rig, script)
    is_told(verdict, 30.0)
    assert output == REST
    assert one.tuning.controller.restored


def test_a_sensor_that_is_lost_is_told_as_that(rig, virtual):
    """Also where the program is a little late again and again."""

    async def script(call, number, _names):
        if call == "read" and 20.0 < asyncio.get_running_loop().time() < 23.0:
            pause(0.02)
            raise SILENT

    _, verdict, _ = conducted(virtual, rig, script)
    assert verdict.code == "pv_lost"
    assert SILENT.message in verdict.message


def test_a_short_pause_ends_nothing(rig, virtual):
    _, verdict, _ = conducted(virtual, rig, paused=lambda: pause(0.4))
    assert verdict.outcome == "done"


def test_a_computer_that_slept(rig, virtual, monkeypatch):
    """The clock of the event loop stands still then: the other one tells."""
    slept = [0.0]
    monkeypatch.setattr(ticker, "asleep_s", lambda: slept[0])
    _, verdict, output = conducted(virtual, rig, paused=lambda: slept.__setitem__(0, 3600.0))
    is_told(verdict, 3600.0)
    assert output == REST


def test_how_long_this_computer_has_slept_is_known():
    assert ticker.asleep_s() >= -1.0
    assert ticker._noted(0.01) == 0.0


def test_the_larger_part_counts():
    """Of the time without a PV, limit 10 s."""

    def code(still_s, lost_s):
        watched = Supervisor(Limits((0.0, 100.0)), SafetySettings(pv_timeout_s=10.0, max_lateness_s=10.0))
        watched.check_blindness(0.0, usable=True)
        verdict = watched.check_failure(still_s + lost_s, still_s, SILENT)
        return verdict and verdict.code

    assert code(10.1, 0.0) == code(6.0, 5.0) == code(30.0, 30.0) == "process_stalled"
    assert code(4.0, 7.0) == code(0.0, 10.1) == "pv_lost"
    assert code(5.0, 4.9) is None


@pytest.mark.realtime
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="nothing is paused by a signal here")
def test_a_loop_process_that_was_stopped_by_a_signal(tmp_path):
    """The PLC's own output is looked at, and held while nobody drives it."""
    with ExitStack() as stack:
        plc = plc_with_plant(stack, tmp_path)
        config = Path(plc.config)
        config.write_text(config.read_text().replace(f"= {PATIENCE_S}", "= 2.0"))
        service = spawn(stack, "serve", "--json", "--config", plc.config)
        url = json.loads(service.stdout.readline())["listening"]
        posted = httpx.post(f"{url}/v1/loops/TIC-101/tunings", timeout=PATIENCE_S).raise_for_status().json()
        until(lambda: abs(plc.output() - REST) > 1.0)
        process = loop_process_of(service)
        os.kill(process, signal.SIGSTOP)
        time.sleep(3.0)  # noqa: TID251 - the pause itself: less than that after which the service would kill it
        os.kill(process, signal.SIGCONT)

        def ended():
            told = httpx.get(f"{url}{posted['links']['self']}", timeout=PATIENCE_S).json()
            return told if told["state"] == "ended" else None

        told = until(ended)
        assert told["verdict"]["code"] == "process_stalled"
        assert told["restored"]
        assert plc.output() == REST
        service.send_signal(signal.SIGTERM)
        assert service.wait(PATIENCE_S) == 0
