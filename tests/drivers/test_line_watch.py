"""When a line may be used again: hand-worked cases and the rule under random lateness."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_drivers.modbus.line_watch import LineSettings, LineWatch, strip_echo

TIMING = LineSettings(patience_s=1.0, gap_s=0.05, pause_s=0.01)
REQUEST = bytes([1, 4, 0, 0, 0, 1, 0x31, 0xCA])
ANSWER = bytes([1, 4, 2, 0, 7, 0xF8, 0xF2])


def sent_at(t: float, settings: LineSettings = TIMING) -> LineWatch:
    watch = LineWatch(settings)
    watch.expect(len(ANSWER))
    watch.sent(REQUEST, t)
    return watch


def test_a_fresh_line_is_free():
    assert LineWatch(TIMING).ready_s() == -math.inf


def test_after_an_answer_the_device_gets_its_pause():
    watch = sent_at(10.0)
    watch.received(ANSWER, 10.2)
    watch.answered(10.2)
    assert watch.ready_s() == 10.2 + 0.01
    assert not watch.garbled(20.0)


def test_an_owed_answer_blocks_the_line_until_patience_ends():
    assert sent_at(10.0).ready_s() == 11.0


def test_a_late_answer_frees_the_line_at_once():
    watch = sent_at(10.0)
    assert watch.received(ANSWER, 10.8) == ANSWER
    assert watch.ready_s() == 10.8 + 0.05


def test_part_of_an_answer_frees_nothing():
    watch = sent_at(10.0)
    watch.received(ANSWER[:-1], 10.8)
    assert watch.ready_s() == 11.0
    watch.received(ANSWER[:-1], 10.99)
    assert watch.ready_s() == 10.99 + 0.05


def test_an_answer_in_pieces_is_counted_once():
    watch = sent_at(10.0)
    for cut in range(1, len(ANSWER)):
        watch.received(ANSWER[:cut], 10.1)
        assert watch.ready_s() == 11.0
    watch.received(ANSWER, 10.2)
    assert watch.ready_s() == 10.25


def test_bytes_that_the_library_threw_away_still_count():
    watch = sent_at(10.0)
    watch.received(b"\xff" * 5, 10.1)
    watch.received(b"\xee\xee", 10.1)
    assert watch.garbled(10.15)


def test_garbled_is_told_after_the_silence_and_not_before():
    watch = sent_at(10.0)
    watch.received(bytes(7), 10.1)
    assert not watch.garbled(10.149)
    assert watch.garbled(10.15)


def test_silence_alone_is_not_garbled():
    assert not sent_at(10.0).garbled(100.0)


def test_with_echo_an_answer_is_owed_behind_it():
    watch = sent_at(10.0, LineSettings(patience_s=1.0, echo=True))
    assert watch.received(REQUEST, 10.01) == b""
    assert watch.ready_s() == 11.0
    assert watch.received(REQUEST + ANSWER, 10.1) == ANSWER
    assert watch.ready_s() == 10.15


def test_echo_is_taken_off_once_and_only_when_it_is_one():
    assert strip_echo(REQUEST + ANSWER, REQUEST) == ANSWER
    assert strip_echo(REQUEST + REQUEST, REQUEST) == REQUEST
    assert strip_echo(REQUEST[:3], REQUEST) == b""
    assert strip_echo(b"", REQUEST) == b""
    assert strip_echo(ANSWER, REQUEST) == ANSWER


@given(packet=st.binary(min_size=1, max_size=12), rest=st.binary(max_size=12))
def test_echo_leaves_the_answer_whole_however_it_arrives(packet, rest):
    whole = packet + rest
    for cut in range(len(whole) + 1):
        assert rest.startswith(strip_echo(whole[:cut], packet))
    assert strip_echo(whole, packet) == rest


@settings(deadline=None)
@given(lateness=st.lists(st.floats(0.0, 0.999), min_size=1, max_size=30))
def test_no_answer_within_patience_ever_meets_another_request(lateness):
    """Each request is answered late by so much; a request is sent as soon as the watch allows it."""
    watch, now = LineWatch(TIMING), 0.0
    for max_lateness_s in lateness:
        now = max(now, watch.ready_s())
        watch.expect(len(ANSWER))
        watch.sent(REQUEST, now)
        arrives = now + max_lateness_s
        assert watch.ready_s() >= arrives
        watch.received(ANSWER, arrives)
        assert arrives < watch.ready_s() <= now + 1.0 + TIMING.gap_s
        now = arrives
