"""Whatever happens, the output ends where it was or at the declared safe value, and the tuning has a verdict."""

import asyncio
import math
from itertools import pairwise
from types import SimpleNamespace

import pytest

from autotuner.core.verdict import aborted
from autotuner.errors import DeviceRefusedError, LinkError
from autotuner.ports import AUTO, OUTPUT, PV

pytestmark = pytest.mark.usefixtures("without_diagnosis")

LINK_DOWN = LinkError("the line is dead", remedy="Plug it in.")


def failing(call, first, last=math.inf, error=LINK_DOWN):
    """A script that raises on the given calls."""

    async def script(now, number, _names):
        if now == call and first <= number <= last:
            raise error

    return script


def pv_from(first, value):
    """A script that replaces the PV from a read on."""

    async def script(call, number, names):
        return {PV: value} if call == "read" and number >= first and PV in names else None

    return script


def outcomes(tuning):
    return [event.type for event in tuning.events if event.type in {"restored", "output_unknown", "ended"}]


FAULTS = {
    "reads fail": (failing("read", 100, 140), "pv_lost"),
    "reads fail for a moment": (failing("read", 100, 105), None),
    "a write fails": (failing("write", 2, 2), "device_error"),
    "a write is refused": (failing("write", 3, 3, DeviceRefusedError("no", remedy="Ask again.")), "device_error"),
    "PV is NaN": (pv_from(150, math.nan), "pv_lost"),
    "PV jumps over its limit": (pv_from(150, 400.0), "pv_limit"),
    "the sensor falls out": (pv_from(150, -300.0), "pv_limit"),
    "the driver has a bug": (failing("read", 120, 120, ZeroDivisionError("bug")), "internal_error"),
}


@pytest.mark.parametrize("auto", [False, True], ids=["manual", "auto"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_with_the_loop_as_it_was_found(rig, virtual, fault, auto):
    script, code = FAULTS[fault]

    async def main():
        one = rig(script, {"auto": auto, "gains": {"kp": 0.5, "ti": 10.0, "td": 0.0}})
        verdict = await one.conduct()
        return one, verdict, await one.now(OUTPUT, AUTO)

    one, verdict, after = virtual(main())
    assert (verdict.code if code else verdict.outcome) == (code or "done")
    assert verdict.remedy or not code
    assert one.tuning.controller.restored
    assert after[AUTO] == float(auto)
    if not auto:
        assert after[OUTPUT] == 40.0
    assert [values[OUTPUT] for values in one.backend.written if OUTPUT in values][-1] == pytest.approx(40.0, abs=2.0)
    assert outcomes(one.tuning)[-2:] == ["restored", "ended"]
    assert all(0.0 <= values.get(OUTPUT, 0.0) <= 100.0 for values in one.backend.written)


def test_abort_restores_at_once(rig, virtual):
    async def main():
        one = rig()
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(12.3)
        one.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))
        verdict = await work
        return verdict, asyncio.get_running_loop().time(), await one.now(OUTPUT)

    verdict, now, after = virtual(main())
    assert verdict.code == "aborted"
    assert after[OUTPUT] == 40.0
    assert now < 12.5


def test_cancelling_restores_before_the_cancellation_is_felt(rig, virtual):
    async def main():
        one = rig()
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(15.0)
        for _ in range(3):
            work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work
        return one, await one.now(OUTPUT)

    one, after = virtual(main())
    assert after[OUTPUT] == 40.0
    assert one.tuning.verdict.code == "cancelled"
    assert one.backend.counts["close"] == 1


def test_a_dead_link_is_tried_until_it_is_back(rig, virtual):
    """From 12 s to 42 s nothing gets through: the output is reported unknown, then restored."""

    async def dead_for_a_while(_call, _number, _names):
        if 12.0 < asyncio.get_running_loop().time() < 42.0:
            raise LINK_DOWN

    async def main():
        one = rig(dead_for_a_while)
        verdict = await one.conduct()
        return one, verdict, asyncio.get_running_loop().time(), await one.now(OUTPUT)

    one, verdict, now, after = virtual(main())
    assert verdict.code == "pv_lost"
    assert LINK_DOWN.message in verdict.message
    assert verdict.remedy.startswith(LINK_DOWN.remedy)
    assert after[OUTPUT] == 40.0
    assert outcomes(one.tuning).count("output_unknown") >= 10
    assert outcomes(one.tuning)[-2:] == ["restored", "ended"]
    assert 42.0 <= now <= 45.0


@pytest.mark.parametrize(("device_gone", "code"), [("end", "device_gone"), ("wait", None)])
def test_a_device_that_says_it_is_gone_is_not_waited_for(rig, virtual, device_gone, code):
    """It tells between two samples, at 12.34 s, and answers again from 15 s on."""
    moment_s, back_s = 12.34, 15.0

    async def dead_for_a_while(_call, _number, _names):
        if moment_s <= asyncio.get_running_loop().time() < back_s:
            raise LINK_DOWN

    async def main():
        one = rig(dead_for_a_while, safety={"device_gone": device_gone, "pv_timeout_s": 5.0})
        loop, told = asyncio.get_running_loop(), []

        def watch(gone):
            told.append(gone)
            if gone is not None:
                loop.call_at(moment_s, gone, "it hung up")

        one.backend.watch = watch
        verdict = await one.conduct()
        return one, verdict, told, await one.now(OUTPUT)

    one, verdict, told, after = virtual(main())
    link = next(event for event in one.tuning.events if event.type == "link")
    assert (link.t, link.message) == (pytest.approx(moment_s, abs=0.11), "it hung up")
    assert after[OUTPUT] == 40.0
    assert told[-1] is None
    if code is None:
        assert verdict.outcome == "done"
        return
    assert verdict.code == code
    restored = next(event for event in one.tuning.events if event.type == "restored")
    assert back_s <= restored.t <= back_s + 2.0, "the longest pause between two attempts is 2 s"


def test_a_link_that_stays_dead_ends_as_not_restored(rig, virtual):
    async def main():
        one = rig(failing("write", 2), restore_limit_s=60.0)
        return one, await one.conduct()

    one, verdict = virtual(main())
    assert (verdict.outcome, verdict.code) == ("failed", "output_unknown")
    assert "40" in verdict.remedy
    assert one.tuning.controller.restored is False
    assert one.tuning.to_dict()["restored"] is False
    assert outcomes(one.tuning)[-1] == "ended"


def test_a_safety_trip_goes_to_the_declared_safe_output(rig, virtual):
    async def main():
        limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "safe_output": 5.0}
        one = rig(pv_from(150, 400.0), limits=limits)
        await one.conduct()
        return await one.now(OUTPUT)

    assert virtual(main())[OUTPUT] == 5.0


def test_the_operator_taking_the_loop_back_is_not_fought(rig, virtual):
    async def main():
        one = rig(device={"auto": True, "gains": {"kp": 0.5, "ti": 10.0, "td": 0.0}})
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(12.0)
        await one.device.write({AUTO: 1.0})
        written = len(one.backend.written)
        verdict = await work
        return one, verdict, one.backend.written[written:]

    one, verdict, written_afterwards = virtual(main())
    assert verdict.code == "mode_changed"
    assert written_afterwards == []
    assert one.tuning.controller.restored


def test_slew_limit_holds_for_every_write_also_on_the_way_back(rig, virtual):
    async def main():
        limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 20.0}
        one = rig(limits=limits)
        await one.conduct()
        return one, await one.now(OUTPUT)

    one, ended_at = virtual(main())
    outputs = [40.0, *(values[OUTPUT] for values in one.backend.written)]
    steps = [abs(after - before) for before, after in pairwise(outputs)]
    assert max(steps) <= 20.0 * 0.1 + 1e-9
    assert ended_at[OUTPUT] == 40.0


def test_unreachable_device_is_a_verdict(rig, virtual):
    async def main():
        return await rig(failing("open", 1)).conduct()

    verdict = virtual(main())
    assert (verdict.outcome, verdict.code) == ("failed", "device_unreachable")
    assert (verdict.message, verdict.remedy) == (LINK_DOWN.message, LINK_DOWN.remedy)  # the remedy is told once


@pytest.mark.parametrize(
    ("device", "keys", "code"),
    [
        ({}, {"process_action": "reverse"}, "wrong_action"),
        ({"plant": {"structure": "fopdt", "K": 3e-3, "T": 10.0, "D": 1.5}}, {}, "oscillation_in_noise"),
        (
            {"plant": {"structure": "integrating", "K": 1e-9, "T": 0.0, "D": 1.0}},
            {"relay": {"amplitude": 10.0, "hysteresis": 1.0, "response_limit_s": 200.0}},
            "no_oscillation",
        ),
        ({"effects": [{"effect": "drift", "rate_per_s": 1.0}]}, {}, "pv_drifts"),
        ({"output0": 40.0}, {"limits": {"output": [50.0, 100.0], "pv": [0.0, 250.0]}}, "output_outside_limits"),
    ],
)
def test_a_process_that_gives_no_result_is_refused_with_advice(rig, virtual, device, keys, code):
    async def main():
        relay = {"amplitude": 10.0, "response_limit_s": 2000.0}
        one = rig(device=device, **({"relay": relay} | keys))
        verdict = await one.conduct()
        return verdict, await one.now(OUTPUT)

    verdict, after = virtual(main())
    assert (verdict.outcome, verdict.code) == ("refused", code)
    assert verdict.remedy
    assert after[OUTPUT] == 40.0


@pytest.mark.parametrize("abort_s", [60.0, 60.05, 59.9])
def test_a_slew_finer_than_the_registers_of_the_device_still_gets_there(rig, virtual, abort_s):
    """0.2 a second at ten samples a second on a device that rounds to 0.1: the way is counted, not what is read."""

    async def main():
        limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 0.2}
        one = rig(limits=limits, relay={"amplitude": 1.0, "check": False})
        read = one.device.read

        async def rounded(names):
            return {name: round(value, 1) if name == OUTPUT else value for name, value in (await read(names)).items()}

        one.device.read = rounded
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(abort_s)
        one.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))
        await work
        return [values[OUTPUT] for values in one.backend.written]

    written = virtual(main())
    assert max(written) > 40.5
    assert max(abs(after - before) for before, after in pairwise([40.0, *written])) <= 0.02 + 1e-9


CALLS = ("readable", "writable", "open", "write", "close")
AUTO_LOOP = {"auto": True, "gains": {"kp": 0.5, "ti": 10.0, "td": 0.0}, "noise": 0.5}


def test_take_over_holds_the_mean_of_what_the_controller_drove(rig, virtual):
    """One reading of the output has the noise of the PV times the gain in it."""

    seen = []

    async def main():
        one = rig(device=AUTO_LOOP)
        read = one.device.read

        async def watched(names):
            values = await read(names)
            if not one.backend.written and OUTPUT in names:
                seen.append(values[OUTPUT])
            return values

        one.backend.inner = SimpleNamespace(**{name: getattr(one.device, name) for name in CALLS}, read=watched)
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(4.0)
        one.tuning.abort(aborted("requested", "stopped", "Start it again."))
        await work
        return one

    one = virtual(main())
    first = next(values[OUTPUT] for values in one.backend.written if OUTPUT in values)
    assert one.backend.written[0] == {AUTO: 0.0}
    assert first == one.tuning.before.output
    assert first == pytest.approx(sum(seen[-25:]) / 25.0)
    assert max(seen) - min(seen) > 0.3


def test_a_scan_lies_between_output_and_mode(rig, virtual):
    times = []

    async def timed(call, _number, names):
        if call == "write":
            times.append((asyncio.get_running_loop().time(), set(names)))

    async def main():
        one = rig(timed, AUTO_LOOP, scan_s=0.7)
        work = asyncio.create_task(one.conduct())
        await one.moved()
        one.tuning.abort(aborted("requested", "stopped", "Start it again."))
        await work

    virtual(main())
    (taken_s, _), (held_s, _) = times[:2]
    (output_s, output), (mode_s, mode) = times[-2:]
    assert (output, mode) == ({OUTPUT}, {AUTO})
    assert held_s - taken_s == pytest.approx(0.7)
    assert mode_s - output_s == pytest.approx(0.7)


def test_a_mode_that_is_acknowledged_and_ignored_is_not_restored(rig, virtual):
    async def deaf(call, _number, names):
        return {AUTO: 0.0} if call == "read" and AUTO in names and deaf.begun else None

    deaf.begun = False

    async def main():
        one = rig(deaf, AUTO_LOOP, restore_limit_s=20.0)
        work = asyncio.create_task(one.conduct())
        await one.moved()
        deaf.begun = True
        one.tuning.abort(aborted("requested", "stopped", "Start it again."))
        return await work, one.tuning

    verdict, tuning = virtual(main())
    assert verdict.code == "output_unknown"
    assert any("acknowledged auto" in event.message for event in tuning.events if event.type == "output_unknown")


@pytest.mark.parametrize(("auto", "ends_at"), [(False, 5.0), (True, 40.0)])
def test_a_loop_in_manual_ends_at_its_safe_output_where_that_is_declared(rig, virtual, auto, ends_at):
    """For a board that holds its last output; a device whose own controller takes over again is restored."""
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "safe_output": 5.0, "at_end": "safe"}

    async def main():
        one = rig(device={"auto": auto, "gains": {"kp": 0.0, "ti": 0.0, "td": 0.0}}, limits=limits)
        work = asyncio.create_task(one.conduct())
        await one.moved()
        one.tuning.abort(aborted("requested", "stopped", "Start it again."))
        await work
        return [values[OUTPUT] for values in one.backend.written if OUTPUT in values][-1]

    assert virtual(main()) == pytest.approx(ends_at, abs=0.2)
