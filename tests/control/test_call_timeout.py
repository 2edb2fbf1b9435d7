"""A driver that never answers must not keep a heater on, nor keep an abort waiting."""

import asyncio
import math
from itertools import pairwise

import pytest

from autotuner.control.clock.call_timeout import BackendWithTimeout
from autotuner.core.verdict import aborted
from autotuner.errors import DeviceTimeoutError, LinkError
from autotuner.ports import AUTO, OUTPUT, PV

NEVER_S = 1e6


def hanging(call, first, last=math.inf):
    """A script under which a call waits for ever, against the port's promise."""

    async def script(now, number, _names):
        if now == call and first <= number <= last:
            await asyncio.sleep(NEVER_S)

    return script


@pytest.mark.parametrize("call", ["open", "read", "write", "close"])
def test_every_call_ends(rig, virtual, call):
    async def main():
        one = rig(hanging(call, 1))
        patient = BackendWithTimeout(one.backend, 5.0)
        arguments = {"read": [[PV]], "write": [{OUTPUT: 1.0}]}.get(call, [])
        with pytest.raises(DeviceTimeoutError):
            await getattr(patient, call)(*arguments)
        return asyncio.get_running_loop().time()

    assert virtual(main()) == pytest.approx(5.0)


def test_an_interrupted_call_ends_at_once_and_the_next_is_not_affected(rig, virtual):
    async def main():
        one = rig(hanging("read", 1, 1))
        patient = BackendWithTimeout(one.device, 5.0)
        patient.interrupt()
        await patient.open()
        slow = asyncio.create_task(BackendWithTimeout(one.backend, 5.0).read([PV]))
        await asyncio.sleep(1.0)
        slow.cancel()
        waiting = BackendWithTimeout(one.backend, 50.0)
        one.backend.counts["read"] = 0
        reading = asyncio.create_task(waiting.read([PV]))
        await asyncio.sleep(1.0)
        waiting.interrupt()
        with pytest.raises(DeviceTimeoutError):
            await reading
        assert asyncio.get_running_loop().time() == pytest.approx(2.0)
        return await waiting.read([PV])

    assert virtual(main())[PV] == pytest.approx(80.0, abs=1.0)


def test_a_failure_of_the_device_passes_unchanged(rig, virtual):
    failure = LinkError("the line is dead", remedy="Plug it in.")

    async def script(_call, _number, _names):
        raise failure

    async def main():
        with pytest.raises(LinkError) as caught:
            await BackendWithTimeout(rig(script).backend).read([PV])
        return caught.value

    assert virtual(main()) is failure


@pytest.mark.parametrize(("call", "first", "code"), [("read", 100, "pv_lost"), ("write", 2, "device_error")])
def test_a_hanging_call_ends_the_tuning_and_the_output_goes_back(rig, virtual, call, first, code):
    async def main():
        one = rig(hanging(call, first, first))
        verdict = await one.conduct()
        return one, verdict, await one.now(OUTPUT), asyncio.get_running_loop().time()

    one, verdict, after, now = virtual(main())
    assert verdict.code == code
    assert after[OUTPUT] == 40.0
    assert one.tuning.controller.restored
    last = one.tuning.controller.samples[-1].t
    assert now - last < 2.5  # blind for 2 s at most


def test_an_abort_does_not_wait_for_an_answer(rig, virtual):
    async def main():
        one = rig(hanging("read", 120, 120), safety={"pv_timeout_s": 500.0})
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(20.0)
        one.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))
        verdict = await work
        return verdict, asyncio.get_running_loop().time(), await one.now(OUTPUT)

    verdict, now, after = virtual(main())
    assert verdict.code == "aborted"
    assert now < 20.2
    assert after[OUTPUT] == 40.0


def test_a_device_that_cannot_be_disconnected_keeps_its_verdict(rig, virtual):
    async def script(call, _number, _names):
        if call == "close":
            raise LinkError("the line is dead", remedy="Plug it in.")

    async def main():
        return await rig(script).conduct()

    assert virtual(main()).outcome == "done"


def test_a_device_in_auto_that_cannot_be_taken_to_manual_is_refused(rig, virtual, monkeypatch):
    async def main():
        one = rig(device={"auto": True})
        monkeypatch.setattr(type(one.backend), "writable", frozenset({OUTPUT}))
        verdict = await one.conduct()
        return verdict, one.backend.written, await one.now(AUTO)

    verdict, written, after = virtual(main())
    assert (verdict.outcome, verdict.code) == ("refused", "device_in_auto")
    assert written == []
    assert after[AUTO] == 1.0


def test_a_bug_of_the_driver_during_the_restore_is_tried_again(rig, virtual):
    async def script(call, number, _names):
        if call == "write" and 3 <= number <= 6:
            raise ZeroDivisionError("bug")

    async def main():
        one = rig(script)
        verdict = await one.conduct()
        return verdict, await one.now(OUTPUT)

    verdict, after = virtual(main())
    assert verdict.code == "internal_error"
    assert after[OUTPUT] == 40.0


def test_the_sample_that_trips_is_in_the_record(rig, virtual):
    async def script(call, number, names):
        return {PV: 400.0} if call == "read" and number >= 150 and PV in names else None

    async def main():
        one = rig(script)
        await one.conduct()
        return one.tuning.recording()

    assert virtual(main()).pv[-1] == 400.0


def test_the_way_back_goes_on_where_it_was_interrupted(rig, virtual):
    """A slew-limited way back that loses the link half way does not leap back to where it began."""

    async def script(call, _number, _names):
        if call == "write" and 14.5 < asyncio.get_running_loop().time() < 20.0:
            raise LinkError("the line is dead", remedy="Plug it in.")

    async def main():
        limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 5.0}
        one = rig(script, limits=limits)
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(14.0)
        one.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))
        await work
        return [values[OUTPUT] for values in one.backend.written], await one.now(OUTPUT)

    written, after = virtual(main())
    steps = [abs(b - a) for a, b in pairwise(written)]
    assert max(steps) <= 0.5 + 1e-9
    assert after[OUTPUT] == 40.0
