"""A line that loses sample after sample makes few lines in the log, and none of safety is left out."""

import asyncio
import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.control.reporting.events import (
    Ended,
    EstimateUpdated,
    LinkTrouble,
    OutputUnknown,
    PhaseChanged,
    SampleTaken,
)
from autotuner.control.reporting.link_log import AGAIN_S, GOOD_S, KINDS, Troubles
from autotuner.errors import LinkError

pytestmark = pytest.mark.usefixtures("without_diagnosis")

NAN = float("nan")


def sample(t):
    return SampleTaken(t, 80.0, 40.0, NAN, 0.0, NAN)


def lost(t, message="ttyS0 did not answer within 1 s. Check the line."):
    return LinkTrouble(t, message)


def lines(events):
    troubles = Troubles()
    return [(told.t, told.message) for event in events for told in troubles.take(event) if told.type == "link"]


def test_trouble_is_told_once_then_counted_and_so_is_its_end():
    """A hundred seconds without an answer, ten times a second, then an answer to each request."""
    events = [lost(0.1 * k) for k in range(1000)] + [sample(100.0 + 0.1 * k) for k in range(300)]
    (first, text), (again, more), (good, count) = lines(events)
    assert (first, text) == (0.0, lost(0.0).message)
    assert again == pytest.approx(AGAIN_S, abs=0.11)
    assert more == f"{lost(0.0).message} (599 more before it)"
    assert good == pytest.approx(100.0 + GOOD_S, abs=0.2)
    assert count == "the device answers again: 1000 calls failed within 99.9 s"


def test_every_second_sample_lost_is_a_line_a_minute():
    events = [lost(0.1 * k) if k % 2 else sample(0.1 * k) for k in range(6000)]
    told = lines(events)
    assert len(told) == 10
    assert {text.partition(" (")[2] for _, text in told[1:]} <= {"299 more before it)", "300 more before it)"}


def test_trouble_of_another_kind_is_told_at_once():
    """Numbers, and what was heard, make no kind."""
    told = lines([
        lost(0.0), lost(1.0, "ttyS0 did not answer within 2 s. Check the line."), lost(2.0, "ttyS0 is gone"),
        lost(3.0, "ttyS0 answered b'\\x01', which is odd"), lost(4.0, "ttyS0 answered b'7', which is odd"),
    ])  # fmt: skip
    assert [t for t, _ in told] == [0.0, 2.0, 3.0]
    assert told[1][1] == "ttyS0 is gone (1 more before it)"


@pytest.mark.parametrize(
    "event", [PhaseChanged(2.0, "restore"), OutputUnknown(2.0, 1, "dead"), Ended(2.0, "failed", "pv_lost", "", "")]
)
def test_what_was_only_counted_is_told_before_what_comes_of_it(event):
    troubles = Troubles()
    for t in (0.0, 0.5, 1.0):
        troubles.take(lost(t))
    told = troubles.take(event)
    assert told[0] == LinkTrouble(2.0, f"2 more failed, the last: {lost(1.0).message}")
    assert told[1] is event
    assert troubles.take(event) == (event,)


@given(st.lists(st.tuples(st.sampled_from(["lost", "other", "good", "unknown", "estimate"]), st.floats(0.01, 30.0))))
def test_nothing_of_safety_is_left_out_and_no_trouble_is_lost(story):
    """Whatever happens in whatever order: all of the others pass, and every trouble is told or counted."""
    troubles, t, trouble, told, passed, others = Troubles(), 0.0, 0, [], [], []
    for kind, pause_s in story:
        t += pause_s
        event = {
            "lost": lost(t),
            "other": lost(t, "is gone"),
            "good": sample(t),
            "unknown": OutputUnknown(t, 1, "dead"),
            "estimate": EstimateUpdated(t, 1, 1.0, 1.0, 1.0, 1.0),
        }[kind]
        trouble += event.type == "link"
        others += [event] if kind in {"unknown", "estimate"} else []
        for one in troubles.take(event):
            (told if one.type == "link" else passed).append(one)
    assert passed == others
    troubled = {event.message.split(" (")[0] for event in told}
    assert not trouble or troubled & {lost(0.0).message, "is gone"}


def test_of_many_kinds_a_few_are_told_by_themselves():
    told = lines([lost(0.1 * k, f"failed: {chr(97 + k // 26)}{chr(97 + k % 26)}") for k in range(400)])
    assert len(told) == KINDS


def test_a_tuning_over_a_line_that_loses_every_third_sample(rig, virtual, caplog):
    """It was a line of the log for each of them."""

    async def flickering(call, number, _names):
        if call == "read" and number > 20 and number % 3 == 0:
            raise LinkError("the line is busy", remedy="Wait.")

    async def main():
        one = rig(flickering)
        await one.conduct()
        return one.tuning

    tuning = virtual(main())
    lost_samples = sum(event.type == "link" for event in tuning.events)
    told = [record for record in caplog.records if "the line is busy" in record.getMessage()]
    assert lost_samples > 100
    assert 1 <= len(told) <= 6
    assert all(record.levelno == logging.WARNING for record in told)


def test_a_line_that_dies_is_told_and_so_is_each_look_for_the_output(rig, virtual, caplog):
    async def dying(_call, _number, _names):
        if dying.loop.time() > 20.0:
            raise LinkError("the line is dead", remedy="Plug it in.")

    async def main():
        dying.loop = asyncio.get_running_loop()
        one = rig(dying, restore_limit_s=30.0)
        await one.conduct()
        return one.tuning

    tuning = virtual(main())
    told = [record.getMessage() for record in caplog.records]
    assert sum("the line is dead. Plug" in line and "unknown" not in line for line in told) == 2
    unknown = sum(event.type == "output_unknown" for event in tuning.events)
    assert sum("output unknown" in line for line in told if "attempt" in line) == unknown > 10
