"""One damaged reading of mode, set point or output ends no tuning; an operator does, with the next sample."""

import asyncio
import math

import numpy as np
import pytest

from autotuner.control.devices.confirmed_read import read_surely
from autotuner.core.verdict import aborted
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT

pytestmark = pytest.mark.usefixtures("without_diagnosis")

AT = 150
"""Reading that is damaged, in the relay phase."""


def damaged(**signals):
    """A script that replaces readings: `name=(numbers, value)`."""

    async def script(call, number, names):
        if call != "read":
            return None
        return {
            name: value for name, (numbers, value) in signals.items() if number in numbers and name in names
        } or None

    return script


def told(tuning):
    return [event.message for event in tuning.events if event.type == "link"]


SINGLE = {
    "set point reads 0": ({SET_POINT: ({AT}, 0.0)}, 1),
    "set point reads no number": ({SET_POINT: ({AT}, math.nan)}, 0),
    "a bit of the set point": ({SET_POINT: ({AT}, 80.0 + 2.0**15)}, 1),
    "mode reads auto": ({AUTO: ({AT}, 1.0)}, 1),
    "mode reads no number": ({AUTO: ({AT}, math.nan)}, 1),
    "output reads 0": ({OUTPUT: ({AT}, 0.0)}, 1),
    "all of a message": ({SET_POINT: ({AT}, 0.0), AUTO: ({AT}, 1.0), OUTPUT: ({AT}, 0.0), PV: ({AT}, 0.0)}, 3),
}


@pytest.mark.parametrize("fault", SINGLE)
def test_one_damaged_reading_ends_nothing_and_is_told(rig, virtual, fault):
    signals, readings = SINGLE[fault]

    async def main():
        limits = {"output": [0.0, 100.0], "pv": [-10.0, 250.0]}
        one = rig(damaged(**signals), relay={"amplitude": 10.0, "check": False}, limits=limits)
        return one, await one.conduct(), await one.now(OUTPUT)

    one, verdict, after = virtual(main())
    assert verdict.outcome == "done", verdict
    assert after[OUTPUT] == 40.0
    warnings = [text for text in one.tuning.to_dict()["warnings"] if "damaged readings" in text]
    assert len(warnings) == (readings > 0)
    assert all(f"{readings} in all" in text for text in warnings)


def test_a_reading_in_doubt_is_told_at_once(rig, virtual):
    async def main():
        one = rig(damaged(set_point=({AT}, 0.0)), relay={"amplitude": 10.0, "check": False})
        await one.conduct()
        return one

    (text,) = told(virtual(main()).tuning)
    assert "the set point went from 80 to 0" in text
    assert "damaged" in text


CHANGES = {
    "set point": ({SET_POINT: 90.0}, "set_point_changed"),
    "mode": ({AUTO: 1.0}, "mode_changed"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_an_operator_does_ends_it_with_the_second_sample_and_nothing_is_written_before(rig, virtual, change):
    """Samples come every 0.1 s: it is seen within 0.1 s, and certain 0.1 s later; then a scan before the mode."""
    done, code = CHANGES[change]

    async def main():
        # A controller that does nothing: the mean of its output, where the way back ends, is the output at the start.
        one = rig(device={"auto": True, "gains": {"kp": 0.0, "ti": 10.0, "td": 0.0}})
        work = asyncio.create_task(one.conduct())
        await asyncio.sleep(12.02)
        await one.device.write(done)
        written = len(one.backend.written)
        verdict = await work
        verdict_s = asyncio.get_running_loop().time()
        (restored_s,) = [event.t for event in one.tuning.events if event.type == "restored"] or [verdict_s]
        return verdict, restored_s, one.loop.device_scan_s, one.backend.written[written:], await one.now(OUTPUT, AUTO)

    verdict, restored_s, scan_s, written, after = virtual(main())
    assert verdict.code == code
    released = code != "mode_changed"
    assert restored_s <= 12.02 + 0.2 + 0.1 + scan_s * released
    assert after[AUTO] == 1.0
    assert written == ([] if not released else [{OUTPUT: 40.0}, {AUTO: 1.0}])


@pytest.mark.parametrize("auto", [0.0, 1.0])
def test_an_end_while_the_mode_is_in_doubt_looks_before_it_writes(rig, virtual, auto):
    """Aborted just after a reading of auto: damaged, the output goes back; true, it is whoever took the loop's."""

    async def main():
        one = rig(damaged(auto=({AT}, 1.0)))
        work = asyncio.create_task(one.conduct())
        while one.backend.counts["read"] < AT:  # noqa: ASYNC110 - no event tells of a sample that was not used
            await asyncio.sleep(0.05)
        await one.device.write({AUTO: auto})
        written = len(one.backend.written)
        one.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))
        await work
        return one.backend.written[written:]

    assert virtual(main()) == ([] if auto else [{OUTPUT: 40.0}])


def test_a_mode_that_stays_unknown_ends_with_the_output_back(rig, virtual):
    async def main():
        one = rig(damaged(auto=(range(AT, 10_000), math.nan)))
        return await one.conduct(), await one.now(OUTPUT)

    verdict, after = virtual(main())
    assert verdict.code == "mode_unknown"
    assert verdict.remedy
    assert after[OUTPUT] == 40.0


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("signals", [{OUTPUT: 0.0}, {AUTO: 1.0}, {OUTPUT: math.nan, AUTO: 1.0}], ids=str)
def test_a_damaged_first_look_is_not_what_the_loop_goes_back_to(rig, virtual, signals, number):
    async def main():
        script = damaged(**{name: ({number}, value) for name, value in signals.items()})
        one = rig(script, relay={"amplitude": 10.0, "check": False})
        verdict = await one.conduct()
        return one.tuning.controller.before, verdict, await one.now(OUTPUT, AUTO)

    before, verdict, after = virtual(main())
    assert (before.output, before.auto) == (40.0, 0.0)
    assert verdict.outcome == "done"
    assert after == {OUTPUT: 40.0, AUTO: 0.0}


class Published:
    """A backend that gives one reading after the other."""

    def __init__(self, *readings):
        self.readings = list(readings)

    async def read(self, _names):
        return {"output": self.readings.pop(0)}


@pytest.mark.parametrize(
    ("readings", "output", "left"),
    [
        ((40.0, 40.0, 7.0), 40.0, 1),
        ((40.0, 0.0, 40.0), 40.0, 0),
        ((40.1, 40.3, 40.2), 40.2, 0),
        ((math.nan, 40.0, 40.0), 40.0, 0),
        ((math.nan, 40.0, math.nan), math.nan, 0),
    ],
)
def test_the_middle_of_three_readings_unless_two_agree(virtual, readings, output, left):
    device = Published(*readings)
    assert virtual(read_surely(device, ["output"]))["output"] == pytest.approx(output, nan_ok=True)
    assert len(device.readings) == left


def answered_again(share, seed):
    """A script that answers with an earlier reading of the PV now and then."""
    rng, held = np.random.default_rng(seed), {}

    async def script(call, _number, names):
        if call != "read" or PV not in names:
            return None
        again = rng.random() < share and PV in held
        held[PV] = held.get(PV) if again else (await script.device.read([PV]))[PV]
        return {PV: held[PV]}

    return script


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_a_line_that_answers_with_earlier_readings_is_told(rig, virtual, share):
    async def main():
        script = answered_again(share, 1)
        one = rig(script, relay={"amplitude": 10.0, "check": False})
        script.device = one.device
        return one, await one.conduct()

    one, verdict = virtual(main())
    assert verdict.outcome == "done"
    told_so = [text for text in one.tuning.to_dict()["warnings"] if "equal the one before" in text]
    assert len(told_so) == (share > 0.0)
