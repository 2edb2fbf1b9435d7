"""Registers: words <-> values, against hand-worked bytes and the module `struct`."""

import math
import struct

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from autotuner.errors import DeviceRefusedError
from autotuner_drivers.modbus.registers import Register, raw_limits

NUMBERS = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
FLOATS = {"float32": ("f", 32), "float64": ("d", 64)}
orders = st.sampled_from(["big", "little"])


def holding(kind: str, **more) -> Register:
    return Register("output", "holding", 0, kind, **more)


@pytest.mark.parametrize(
    ("register", "words", "value"),
    [
        # 1234.5 = 0x449A5000 by IEEE 754, worked out by hand: 1.2055664 * 2^10
        (holding("float32"), (0x449A, 0x5000), 1234.5),
        (holding("float32", word_order="little"), (0x5000, 0x449A), 1234.5),
        (holding("float32", byte_order="little"), (0x9A44, 0x0050), 1234.5),
        (holding("float32", word_order="little", byte_order="little"), (0x0050, 0x9A44), 1234.5),
        (holding("float64"), (0x3FF8, 0, 0, 0), 1.5),
        (holding("int16"), (0xFFFF,), -1.0),
        (holding("uint16"), (0xFFFF,), 65535.0),
        (holding("int32"), (0xFFFE, 0x1DC0), -123456.0),
        (holding("int32", word_order="little"), (0x1DC0, 0xFFFE), -123456.0),
        (holding("uint32"), (0x0001, 0x0000), 65536.0),
        (holding("int16", scale=0.5, offset=-10.0), (45,), 12.5),
        (holding("int16", scale=-0.25), (0xFFFC,), 1.0),
        (Register("auto", "coil", 0, "bool"), (1,), 1.0),
    ],
)
def test_hand_worked_words(register, words, value):
    assert register.decode(words) == value
    assert register.encode(value) == words


@given(kind=st.sampled_from(list(NUMBERS)), word_order=orders, byte_order=orders, data=st.data())
def test_integers_agree_with_struct(kind, word_order, byte_order, data):
    size = struct.calcsize(">" + NUMBERS[kind])
    packed = data.draw(st.binary(min_size=size, max_size=size))
    (raw,) = struct.unpack(">" + NUMBERS[kind], packed)
    assume(abs(raw) < 2**53)
    words = _words(packed, word_order, byte_order)
    register = holding(kind, word_order=word_order, byte_order=byte_order)
    assert register.decode(words) == raw
    assert register.encode(float(raw)) == words


@given(kind=st.sampled_from(list(FLOATS)), word_order=orders, byte_order=orders, data=st.data())
def test_floats_agree_with_struct(kind, word_order, byte_order, data):
    code, width = FLOATS[kind]
    value = data.draw(st.floats(allow_nan=False, allow_infinity=False, width=width))
    words = _words(struct.pack(">" + code, value), word_order, byte_order)
    register = holding(kind, word_order=word_order, byte_order=byte_order)
    assert register.decode(words) == value
    assert register.encode(value) == words


def _words(packed: bytes, word_order: str, byte_order: str) -> tuple[int, ...]:
    pairs = [packed[i : i + 2] for i in range(0, len(packed), 2)]
    if word_order == "little":
        pairs.reverse()
    if byte_order == "little":
        pairs = [pair[::-1] for pair in pairs]
    return tuple(pair[0] * 256 + pair[1] for pair in pairs)


@given(
    kind=st.sampled_from([*NUMBERS, "float32"]),
    word_order=orders,
    byte_order=orders,
    scale=st.sampled_from([1.0, 0.1, 0.01, -0.1, 2.5, 1e-3]),
    data=st.data(),
)
def test_what_was_read_writes_back_the_exact_words(kind, word_order, byte_order, scale, data):
    """So gains that were read before others were applied can be put back as they were."""
    register = holding(kind, word_order=word_order, byte_order=byte_order, scale=scale)
    words = tuple(data.draw(st.integers(0, 0xFFFF)) for _ in range(register.size))
    value = register.decode(words)
    assume(math.isfinite(value) and abs(value / scale) < 2.0**50 and value != 0.0)
    assert register.encode(value) == words


@pytest.mark.parametrize(
    ("register", "value", "resolution"),
    [
        (holding("int16", scale=0.1), 12.3, 0.1),
        (holding("uint32", scale=-0.001), 5.0, 0.001),
        (holding("float32"), 1.0, 2.0**-23),
        (holding("float32"), 1234.5, 2.0**-13),
        (holding("float64"), 1.5, 2.0**-52),
        (holding("float32", scale=0.5), 1.0, 2.0**-23),
    ],
)
def test_resolution_by_hand(register, value, resolution):
    assert register.resolution(value) == pytest.approx(resolution, rel=1e-12)


@given(value=st.floats(2.0**-100, 2.0**100, width=32))
def test_resolution_of_a_float32_is_the_step_to_its_neighbour(value):
    (bits,) = struct.unpack(">I", struct.pack(">f", value))
    (neighbour,) = struct.unpack(">f", struct.pack(">I", bits + 1))
    assert holding("float32").resolution(value) == neighbour - value


@given(
    kind=st.sampled_from(["int16", "uint16", "int32"]),
    scale=st.sampled_from([1.0, 0.1, 0.01, -0.1, 2.5]),
    offset=st.floats(-100.0, 100.0),
    share=st.floats(0.0, 1.0),
)
def test_writing_keeps_a_value_to_half_a_count(kind, scale, offset, share):
    register = holding(kind, scale=scale, offset=offset)
    low, high = register.limits
    value = low + share * (high - low)
    assert abs(register.decode(register.encode(value)) - value) <= 0.5 * abs(scale) * (1.0 + 1e-6)


@given(kind=st.sampled_from(list(NUMBERS)), beyond=st.floats(1.0, 1e6), up=st.booleans())
def test_a_value_that_does_not_fit_is_refused_and_never_wrapped(kind, beyond, up):
    low, high = raw_limits(kind)
    value = float(high) + beyond if up else float(low) - beyond
    assume(not low <= value <= high)
    with pytest.raises(DeviceRefusedError, match="does not fit") as refusal:
        holding(kind).encode(value)
    assert refusal.value.field == "output"
    assert refusal.value.value == value


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", ["int16", "float32"])
def test_only_finite_numbers_are_written(kind, value):
    with pytest.raises(DeviceRefusedError, match="finite"):
        holding(kind).encode(value)


def test_a_float32_refuses_what_only_a_float64_holds():
    with pytest.raises(DeviceRefusedError, match="does not fit float32"):
        holding("float32").encode(1e39)
    assert holding("float64").decode(holding("float64").encode(1e39)) == 1e39


@pytest.mark.parametrize(
    ("register", "words"),
    [
        (Register("pv", "input", 0, "int16", invalid=(32767, -32768)), (0x7FFF,)),
        (Register("pv", "input", 0, "int16", invalid=(32767, -32768)), (0x8000,)),
        (Register("pv", "input", 0, "float32"), (0x7FC0, 0x0000)),
        (Register("pv", "input", 0, "float32"), (0x7F80, 0x0000)),
    ],
)
def test_a_value_the_device_cannot_vouch_for_is_nan(register, words):
    assert math.isnan(register.decode(words))


def test_an_invalid_raw_value_is_compared_before_scaling():
    pv = Register("pv", "input", 0, "int16", scale=0.1, invalid=(32767,))
    assert pv.decode((32766,)) == pytest.approx(3276.6)
    assert math.isnan(pv.decode((32767,)))


@pytest.mark.parametrize(
    ("kind", "table", "states", "manual", "auto"),
    [
        ("bool", "coil", (0, 1), (0,), (1,)),
        ("bool", "coil", (1, 0), (1,), (0,)),
        ("uint16", "holding", (4, 9), (4,), (9,)),
        ("int32", "holding", (0, -1), (0, 0), (0xFFFF, 0xFFFF)),
    ],
)
def test_modes(kind, table, states, manual, auto):
    register = Register("auto", table, 0, kind, states=tuple((raw,) for raw in states))
    assert (register.encode(0.0), register.encode(1.0)) == (manual, auto)
    assert (register.decode(manual), register.decode(auto)) == (0.0, 1.0)


def test_a_third_mode_is_an_error_because_it_could_not_be_given_back():
    mode = Register("auto", "holding", 5, "uint16", states=((0,), (1,)))
    with pytest.raises(DeviceRefusedError, match="neither") as refusal:
        mode.decode((2,))
    assert refusal.value.value == 2


def test_a_bit_takes_nothing_but_0_and_1():
    with pytest.raises(DeviceRefusedError, match="0 or 1"):
        Register("auto", "coil", 0, "bool").encode(0.5)


def test_limits_follow_scale_and_offset():
    assert holding("int16", scale=0.1).limits == pytest.approx((-3276.8, 3276.7))
    assert holding("uint16", scale=-1.0, offset=100.0).limits == (-65435.0, 100.0)
