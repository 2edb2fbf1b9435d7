"""Serial protocols as pure dialogues: every byte by hand."""

import math
from functools import reduce

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.errors import ConfigurationError, DeviceRefusedError
from autotuner_drivers.options import Options
from autotuner_drivers.serial.bisynch import Bisynch, check_character, split_messages
from autotuner_drivers.serial.lakeshore import LakeShore
from autotuner_drivers.serial.protocol import DeniedError, number, split_lines
from autotuner_drivers.serial.tclab import TcLab
from autotuner_drivers.serial.template import read_template

NONE = object()
"""The device does not answer this command."""


def play(steps, dialogue):
    """Run steps against a dialogue of (request, answer); return the result."""
    value = None
    lines = iter(dialogue)
    try:
        exchange = next(steps)
        while True:
            request, answer = next(lines)
            assert exchange.request == request
            assert (exchange.meaning is None) == (answer is NONE)
            value = 0.0 if answer is NONE else exchange.meaning(answer)
            assert value is not None, f"{answer!r} was not understood"
            exchange = steps.send(value)
    except StopIteration as end:
        assert next(lines, None) is None, "the dialogue ended early"
        return end.value


# ---- TCLab

DUTY = (b"P1 200.00\n", b"200.00")


def test_tclab_reads():
    lab = TcLab(1, 200.0, 3, read_back=True)
    assert play(lab.enter(), [(b"VER\n", b"TCLab Firmware 2.0.1 Arduino Uno")]) == 2.0
    assert play(lab.read("pv"), [(b"T1\n", b"23.154")]) == 23.154
    assert play(lab.read("output"), [(b"R1\n", b"40.500")]) == 40.5
    assert play(TcLab(2, 100.0, 2, read_back=True).read("pv"), [(b"T2\n", b"-3.25")]) == -3.25


@pytest.mark.parametrize("end", [b"-50.000", b"279.000"])
def test_tclab_reads_a_broken_sensor_as_nan(end):
    assert math.isnan(play(TcLab(1, 200.0, 3, read_back=True).read("pv"), [(b"T1\n", end)]))


def present_lab(version=b"TCLab Firmware 2.0.1 Arduino Uno"):
    lab = TcLab(1, 200.0, 3, read_back=True)
    play(lab.enter(), [(b"VER\n", version)])
    return lab


@pytest.mark.parametrize("version", [b"TCLab Firmware 1.01", b"TCLab-like board"])
def test_tclab_sends_no_duty_to_a_board_that_may_not_know_it(version):
    dialogue = [(b"Q1 40.500\n", b"40.500"), (b"R1\n", b"40.500")]
    assert play(present_lab(version).write("output", 40.5), dialogue) == 40.5


def test_tclab_waits_on_when_something_else_is_said():
    assert next(TcLab(1, 200.0, 3, read_back=True).enter()).meaning(b"High Temp 1 (>100C):") is None


def test_tclab_writes_and_reads_back():
    dialogue = [(b"Q1 40.500\n", b"40.500"), DUTY, (b"R1\n", b"40.500")]
    assert play(present_lab().write("output", 40.5), dialogue) == 40.5
    old = TcLab(2, 100.0, 3, read_back=False)
    assert play(old.write("output", 0.0), [(b"Q2 0.000\n", b"0.000")]) == 0.0
    assert old.readable == {"pv"}


@pytest.mark.parametrize(
    "dialogue",
    [
        [(b"Q1 40.500\n", b"48.500")],
        [(b"Q1 40.500\n", b"40.500"), (b"P1 200.00\n", b"100.00")],
        [(b"Q1 40.500\n", b"40.500"), DUTY, (b"R1\n", b"0.000")],
    ],
    ids=["another value was set", "another duty was set", "the heater went off behind it"],
)
def test_tclab_denies_what_was_not_set(dialogue):
    with pytest.raises(DeniedError, match=r"was set to (40\.5|200), but the device holds"):
        play(present_lab().write("output", 40.5), dialogue)


@pytest.mark.parametrize("value", [-0.1, 100.1])
def test_tclab_refuses_what_the_board_would_clip(value):
    with pytest.raises(DeviceRefusedError, match="0 to 100"):
        play(TcLab(1, 200.0, 3, read_back=True).write("output", value), [])


def test_tclab_tells_the_answers_of_p_by_their_decimals():
    """One flipped bit makes P1 of T1, R1 or Q1."""
    lab = TcLab(1, 200.0, 3, read_back=True)
    for steps in (lab.read("pv"), lab.read("output"), lab.write("output", 40.0)):
        assert next(steps).meaning(b"40.00") is None


def test_the_word_of_a_damaged_command_is_no_number():
    assert number(b"S1") is None


# ---- Lake Shore


def lake_shore(**changes):
    return LakeShore(**({"sensor": "A", "output": 1, "unit": "celsius", "heater_range": 3} | changes))


def test_lakeshore_reads():
    dialogue = [(b"RDGST? A\r\n", b"000"), (b"CRDG? A\r\n", b"+23.150")]
    assert play(lake_shore().read("pv"), dialogue) == 23.15
    dialogue = [(b"RDGST? B\r\n", b"000"), (b"KRDG? B\r\n", b"+296.300")]
    assert play(lake_shore(sensor="B", unit="kelvin").read("pv"), dialogue) == 296.3
    assert play(lake_shore().read("set_point"), [(b"SETP? 1\r\n", b"+300.000")]) == 300.0


def test_lakeshore_reads_a_bad_status_as_nan():
    assert math.isnan(play(lake_shore().read("pv"), [(b"RDGST? A\r\n", b"128"), (b"CRDG? A\r\n", b"+0.00000E+0")]))


def test_lakeshore_counts_an_output_only_while_the_heater_is_on():
    on = [(b"MOUT? 1\r\n", b"+40.00"), (b"RANGE? 1\r\n", b"3")]
    off = [(b"MOUT? 1\r\n", b"+40.00"), (b"RANGE? 1\r\n", b"0")]
    assert play(lake_shore().read("output"), on) == 40.0
    assert play(lake_shore().read("output"), off) == 0.0


def test_lakeshore_sets_the_output_before_it_switches_the_heater_on():
    dialogue = [
        (b"MOUT 1,40.00\r\n", NONE),
        (b"MOUT? 1\r\n", b"+40.00"),
        (b"RANGE? 1\r\n", b"0"),
        (b"RANGE 1,3\r\n", NONE),
        (b"RANGE? 1\r\n", b"3"),
    ]
    assert play(lake_shore().write("output", 40.0), dialogue) == 40.0


def test_lakeshore_leaves_a_heater_that_is_on():
    dialogue = [(b"MOUT 2,12.50\r\n", NONE), (b"MOUT? 2\r\n", b"+12.50"), (b"RANGE? 2\r\n", b"1")]
    assert play(lake_shore(output=2).write("output", 12.5), dialogue) == 12.5


def test_lakeshore_denies_what_is_not_held():
    with pytest.raises(DeniedError, match="holds 0"):
        play(lake_shore().write("output", 40.0), [(b"MOUT 1,40.00\r\n", NONE), (b"MOUT? 1\r\n", b"+0.00")])


def test_lakeshore_leaves_the_heater_as_it_was_found():
    entering = [(b"*IDN?\r\n", b"LSCI,MODEL335,1234567,1.0"), (b"RANGE? 1\r\n", b"0")]
    found = play(lake_shore().enter(), entering)
    assert found == 0.0
    assert play(lake_shore().leave(found), [(b"RANGE 1,0\r\n", NONE)]) == 0.0
    assert play(lake_shore().leave(2.0), []) == 2.0


# ---- EI-Bisynch


def data(content: bytes) -> bytes:
    """Return STX, content, ETX and the exclusive or of everything behind STX."""
    return b"\x02" + content + b"\x03" + bytes([reduce(lambda a, b: a ^ b, content + b"\x03")])


EUROTHERM = Bisynch(0, 1, 1, (-1999.0, 9998.0))
POLL_PV = b"\x040011PV\x05"


def test_bisynch_check_character_by_hand():
    # "SL" "1" ETX: 53 ^ 4c = 1f, ^ 31 = 2e, ^ 03 = 2d
    assert check_character(b"SL1\x03") == b"\x2d"


def test_bisynch_polls():
    assert play(EUROTHERM.read("pv"), [(POLL_PV, data(b"PV  16.4"))]) == 16.4
    assert play(EUROTHERM.read("output"), [(b"\x040011OP\x05", data(b"OP  40.5"))]) == 40.5
    assert play(Bisynch(2, 7, 1, (0.0, 1.0)).read("kp"), [(b"\x042277XP\x05", data(b"XP  50.0"))]) == 50.0


@pytest.mark.parametrize(("status", "auto"), [(b">8000", 0.0), (b">0000", 1.0), (b">A010", 0.0), (b">2010", 1.0)])
def test_bisynch_reads_the_mode_out_of_the_status_word(status, auto):
    assert play(EUROTHERM.read("auto"), [(b"\x040011SW\x05", data(b"SW" + status))]) == auto


def test_bisynch_writes_and_polls_back():
    select = b"\x040011" + data(b"OP40.5")
    assert play(EUROTHERM.write("output", 40.5), [(select, b"\x06"), (b"\x040011OP\x05", data(b"OP  40.5"))]) == 40.5


def test_bisynch_notices_an_output_that_was_acknowledged_and_ignored():
    select = b"\x040011" + data(b"OP40.5")
    with pytest.raises(DeniedError, match="holds 12"):
        play(EUROTHERM.write("output", 40.5), [(select, b"\x06"), (b"\x040011OP\x05", data(b"OP  12.0"))])


def test_bisynch_changes_the_one_bit_of_the_mode():
    poll = b"\x040011SW\x05"
    taking = [
        (poll, data(b"SW>2010")),
        (b"\x040011" + data(b"SW>A010"), b"\x06"),
        (poll, data(b"SW>A010")),
    ]
    giving = [
        (poll, data(b"SW>A010")),
        (b"\x040011" + data(b"SW>2010"), b"\x06"),
        (poll, data(b"SW>2010")),
    ]
    assert play(EUROTHERM.write("auto", 0.0), taking) == 0.0
    assert play(EUROTHERM.write("auto", 1.0), giving) == 1.0


def test_bisynch_a_broken_sensor_is_nan():
    assert math.isnan(play(EUROTHERM.read("pv"), [(POLL_PV, data(b"PV9999.0"))]))


def test_bisynch_refusals():
    with pytest.raises(DeniedError, match="PV: is not a parameter"):
        play(EUROTHERM.read("pv"), [(POLL_PV, b"\x04")])
    with pytest.raises(DeniedError, match="OP: was not acknowledged"):
        play(EUROTHERM.write("output", 40.5), [(b"\x040011" + data(b"OP40.5"), b"\x15")])


@given(place=st.integers(0, 9), bit=st.integers(0, 6))
def test_bisynch_never_understands_a_damaged_answer(place, bit):
    whole = bytearray(data(b"PV  16.4"))
    whole[place] ^= 1 << bit
    exchange = next(EUROTHERM.read("pv"))
    for message in split_messages(bytes(whole))[0]:
        try:
            value = exchange.meaning(message)
        except DeniedError:
            continue
        assert value is None


@given(st.lists(st.sampled_from([data(b"PV  16.4"), data(b"OP   0.3"), b"\x06", b"\x15", b"\x04"]), max_size=6))
def test_bisynch_messages_are_cut_where_they_end_however_they_arrive(messages):
    whole = b"".join(messages)
    for cut in range(len(whole) + 1):
        first, rest = split_messages(whole[:cut])
        second, left = split_messages(rest + whole[cut:])
        assert first + second == messages
        assert left == b""


# ---- lines


@given(st.lists(st.text("T1Q2. 40-", min_size=1, max_size=5).map(str.strip).filter(bool).map(str.encode)))
def test_lines_are_cut_at_either_end_however_they_arrive(lines):
    whole = b"".join(line + b"\r\n" for line in lines)
    for cut in range(len(whole) + 1):
        first, rest = split_lines(whole[:cut])
        second, left = split_lines(rest + whole[cut:])
        assert b"".join(first + second) == b"".join(lines)
        assert left == b""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (b"23.154", 23.154),
        (b"+0.00000E+0", 0.0),
        (b" -3 ", -3.0),
        (b".5", 0.5),
        *[(text, None) for text in (b"nan", b"inf", b"1,5", b"", b"T1", b"0x10", b"1_000")],
    ],
)
def test_numbers(text, value):
    assert number(text) == value


# ---- the user's own

TEMPLATE = {
    "error": "ERR.*",
    "signals": {
        "pv": {"read": "PV?", "answer": "T=([-+.0-9]+)C", "valid": [-50.0, 300.0]},
        "output": {"read": "OUT?", "write": "OUT {output:.2f}", "confirm": "OK"},
        "set_point": {"write": "SP {set_point:.1f}"},
    },
}


def template(**changes):
    return read_template(Options(TEMPLATE | changes))


def test_template_reads_and_writes():
    mine = template()
    assert mine.readable == {"pv", "output"}
    assert mine.writable == {"output", "set_point"}
    assert play(mine.enter(), [(b"PV?\n", b"T=21.5C")]) == 21.5
    assert play(mine.read("pv"), [(b"PV?\n", b"T=-3C")]) == -3.0
    assert math.isnan(play(mine.read("pv"), [(b"PV?\n", b"T=999C")]))
    dialogue = [(b"OUT 40.50\n", b"OK"), (b"OUT?\n", b"40.50")]
    assert play(mine.write("output", 40.5), dialogue) == 40.5
    assert play(mine.write("set_point", 60.0), [(b"SP 60.0\n", NONE)]) == 60.0


def test_template_refusals():
    with pytest.raises(DeniedError, match="output: was refused by the device: ERR 2"):
        play(template().write("output", 40.5), [(b"OUT 40.50\n", b"ERR 2")])
    with pytest.raises(DeniedError, match="holds 30"):
        play(template().write("output", 40.5), [(b"OUT 40.50\n", b"OK"), (b"OUT?\n", b"30")])


def test_template_with_whole_tenths_and_modes_by_their_names():
    mine = template(
        signals={
            "pv": {"read": "PV?", "scale": 0.1, "offset": -20.0, "valid": [-20.0, 300.0]},
            "output": {"read": "OUT?", "write": "OUT {output:04.0f}", "scale": 0.1, "tolerance": 0.05},
            "auto": {"read": "MD?", "write": "MD {auto}", "auto_value": ["AUTO", "REM"], "manual_value": "MAN"},
        }
    )
    assert play(mine.read("pv"), [(b"PV?\n", b"415")]) == pytest.approx(21.5)
    assert math.isnan(play(mine.read("pv"), [(b"PV?\n", b"-1")]))
    assert play(mine.write("output", 40.52), [(b"OUT 0405\n", NONE), (b"OUT?\n", b"0405")]) == pytest.approx(40.5)
    assert mine.step("output") == pytest.approx(0.1)
    assert play(mine.read("auto"), [(b"MD?\n", b"rem")]) == 1.0
    assert play(mine.write("auto", 0.0), [(b"MD MAN\n", NONE), (b"MD?\n", b"MAN")]) == 0.0
    with pytest.raises(DeniedError, match="neither automatic"):
        play(mine.read("auto"), [(b"MD?\n", b"HOLD")])


@pytest.mark.parametrize(
    ("checksum", "message", "whole"),
    [
        # NMEA 0183: the exclusive or of what is between $ and *
        ({"kind": "xor", "before": "*", "skip": 1}, "$GPGLL,5300.97914,N,00259.98174,E,125926,A",
         "$GPGLL,5300.97914,N,00259.98174,E,125926,A*28"),
        ({"kind": "sum"}, "123456789", "123456789DD"),
        ({"kind": "lrc"}, "123456789", "12345678923"),
        # the check value of CRC-16/MODBUS in the catalogue of parametrised CRC algorithms
        ({"kind": "crc16", "before": " "}, "123456789", "123456789 4B37"),
    ],
)  # fmt: skip
def test_template_with_a_checksum(checksum, message, whole):
    mine = template(checksum=checksum, signals=TEMPLATE["signals"] | {"pv": {"read": message, "answer": "(.*)9"}})
    exchange = next(mine.read("pv"))
    assert exchange.request == f"{whole}\n".encode()
    answered = next(template(checksum={"kind": "sum"}).read("pv"))
    assert answered.meaning(b"T=21.5C9A") == 21.5
    assert answered.meaning(b"T=21.5C9a") == 21.5
    for damaged in (b"T=21.5C", b"T=22.5C9A", b"T=21.5C9B", b"9A", b""):
        assert answered.meaning(damaged) is None


def signals(**changes):
    merged = {name: TEMPLATE["signals"][name] | changes.get(name, {}) for name in TEMPLATE["signals"]}
    return {"signals": merged}


@pytest.mark.parametrize(
    ("changes", "key", "value"),
    [
        ({"signals": {"pv": {"read": "T1"}}}, "signals.output.write", None),
        ({"signals": {"output": {"write": "Q {output}"}}}, "signals.pv.read", None),
        (signals(output={"write": "Q1 40"}), "signals.output.write", "Q1 40"),
        (signals(output={"write": "Q1 {heater}"}), "signals.output.write", "Q1 {heater}"),
        (signals(output={"write": "Q1 {output:.2q}"}), "signals.output.write", "Q1 {output:.2q}"),
        (signals(output={"write": "Q1 {output"}), "signals.output.write", "Q1 {output"),
        (signals(pv={"answer": "[0-9]+"}), "signals.pv.answer", None),
        (signals(pv={"answer": "([0-9"}), "signals.pv.answer", "([0-9"),
        (signals(pv={"valid": [3.0, 1.0]}), "signals.pv.valid", [3.0, 1.0]),
        (signals(pv={"unit": "degC"}), "signals.pv.unit", "degC"),
        ({"error": "("}, "error", "("),
        ({"pause_s": -1.0}, "pause_s", -1.0),
        (signals(output={"scale": 0.0}), "signals.output.scale", 0.0),
        ({"checksum": {"kind": "md5"}}, "checksum.kind", "md5"),
        ({"checksum": {"kind": "xor", "before": 3}}, "checksum.before", 3),
    ],
)
def test_a_template_that_cannot_work_is_refused_by_key_value_and_remedy(changes, key, value):
    with pytest.raises(ConfigurationError) as refusal:
        template(**changes)
    assert refusal.value.field == key
    assert refusal.value.remedy
    if value is not None:
        assert refusal.value.value == value
