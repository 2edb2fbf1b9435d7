"""The register map: merging of reads, and every refusal of a map that cannot work."""

from itertools import combinations, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.errors import ConfigurationError
from autotuner_drivers.modbus.register_map import DeviceLimits, plan_reads, read_map
from autotuner_drivers.modbus.registers import TYPES, Register
from autotuner_drivers.options import Options

PV = {"table": "input", "address": 0, "type": "int16", "scale": 0.1}
OUTPUT = {"table": "holding", "address": 0, "type": "int16", "scale": 0.1}


def options(**changes) -> dict[str, object]:
    registers = {"pv": PV, "output": OUTPUT} | changes.pop("registers", {})
    return {"registers": {name: r for name, r in registers.items() if r is not None}} | changes


def test_the_default_map_of_the_simulated_plc_is_read_in_four_requests():
    loop_map = read_map(
        Options(
            options(
                registers={
                    "scans": {"table": "input", "address": 2, "type": "uint16"},
                    "applied": {"table": "input", "address": 1},
                    "set_point": {"table": "holding", "address": 1},
                    "kp": {"table": "holding", "address": 10, "type": "float32"},
                    "ti": {"table": "holding", "address": 12, "type": "float32"},
                    "td": {"table": "holding", "address": 14, "type": "float32"},
                    "auto": {"table": "coil", "address": 0},
                }
            )
        )
    )
    requests = loop_map.reads(loop_map.readable)
    assert [(r.table, r.address, r.count) for r in requests] == [
        ("coil", 0, 1),
        ("holding", 0, 2),
        ("holding", 10, 6),
        ("input", 0, 3),
    ]
    assert loop_map.writable == {"output", "set_point", "kp", "ti", "td", "auto"}


def test_a_request_hands_each_signal_its_own_words():
    loop_map = read_map(
        Options(
            options(
                registers={
                    "pv": {"table": "holding", "address": 2, "type": "int16", "scale": 0.5},
                    "kp": {"table": "holding", "address": 4, "type": "float32"},
                },
                max_gap=1,
            )
        )
    )
    (request,) = loop_map.reads(["pv", "kp"])
    assert request.decode([40, 99, 0x449A, 0x5000]) == {"pv": 20.0, "kp": 1234.5}


@given(
    kind=st.sampled_from(sorted(set(TYPES) - {"bool"})),
    orders=st.tuples(*2 * [st.sampled_from(["big", "little"])]),
    scaled=st.sampled_from([(1.0, 0.0), (0.1, 0.0), (-2.5, 7.0)]),
    data=st.data(),
)
def test_what_decodes_many_answers_decodes_each_register_as_it_does_itself(kind, orders, scaled, data):
    kinds = [kind, "int16", "uint16"]
    registers, address = [], 100
    for k, type_ in enumerate(kinds):
        registers.append(Register(f"r{k}", "holding", address, type_, *orders, *scaled, invalid=(32767, 7)))
        address = registers[-1].end
    (read,) = plan_reads(registers, DeviceLimits(odd_addresses=True))
    words = data.draw(
        st.lists(st.integers(0, 0xFFFF) | st.sampled_from([7, 32767]), min_size=read.count, max_size=read.count)
    )
    own = {r.name: r.decode(words[r.address - 100 : r.end - 100]) for r in registers}
    assert read.decoder()(tuple(words)) == pytest.approx(own, rel=0.0, abs=0.0, nan_ok=True)


def test_the_pv_is_read_last():
    pv = {"table": "coil", "address": 0}
    loop_map = read_map(Options(options(registers={"pv": pv, "more": {"table": "input", "address": 5}})))
    assert [request.table for request in loop_map.reads(["pv", "output", "more"])] == ["holding", "input", "coil"]


@st.composite
def register_lists(draw) -> list[Register]:
    address, registers = 0, []
    for i in range(draw(st.integers(1, 8))):
        address += draw(st.integers(0, 4))
        kind = draw(st.sampled_from(["int16", "float32", "float64"]))
        registers.append(Register(f"r{i}", "holding", address, kind))
        address = registers[-1].end
    return draw(st.permutations(registers))


@settings(deadline=None)
@given(registers=register_lists(), longest=st.integers(4, 20), gap=st.integers(0, 4))
def test_plans_are_lawful_complete_and_as_short_as_can_be(registers, longest, gap):
    requests = plan_reads(registers, DeviceLimits(max_registers_per_read=longest, max_gap=gap))
    assert sorted(r.name for request in requests for r in request.registers) == sorted(r.name for r in registers)
    for request in requests:
        assert _lawful(request.registers, longest, gap)
        assert request.address == request.registers[0].address
        assert request.count == request.registers[-1].end - request.address
    assert len(requests) == _fewest(sorted(registers, key=lambda r: r.address), longest, gap)


def _lawful(group, longest: int, gap: int) -> bool:
    inner = pairwise(group)
    return group[-1].end - group[0].address <= longest and all(b.address - a.end <= gap for a, b in inner)


def _fewest(ordered, longest: int, gap: int) -> int:
    """Try every way to cut the ordered registers."""
    places = range(1, len(ordered))
    for cuts in range(len(ordered)):
        for chosen in combinations(places, cuts):
            ends = (0, *chosen, len(ordered))
            if all(_lawful(ordered[a:b], longest, gap) for a, b in pairwise(ends)):
                return cuts + 1
    raise AssertionError


def test_bits_have_a_limit_of_their_own():
    bits = [Register(f"b{i}", "coil", i, "bool") for i in range(5)]
    assert len(plan_reads(bits, DeviceLimits(max_registers_per_read=1))) == 1
    assert len(plan_reads(bits, DeviceLimits(max_bits_per_read=2))) == 3


FLOAT = {"table": "holding", "address": 10, "type": "float32"}

REFUSALS = {
    "unknown type": (options(registers={"pv": PV | {"type": "int17"}}), "registers.pv.type", "int17"),
    "type of another kind": (options(registers={"pv": PV | {"type": 16}}), "registers.pv.type", 16),
    "float on a bit table": (
        options(registers={"auto": {"table": "coil", "address": 0, "type": "float32"}}),
        "registers.auto.type",
        "float32",
    ),
    "bit in a register": (
        options(registers={"auto": OUTPUT | {"type": "bool", "address": 9}}),
        "registers.auto.type",
        "bool",
    ),
    "unknown table": (options(registers={"pv": PV | {"table": "inputs"}}), "registers.pv.table", "inputs"),
    "address missing": (options(registers={"pv": {"table": "input"}}), "registers.pv.address", None),
    "address too high": (options(registers={"pv": PV | {"address": 300001}}), "registers.pv.address", 300001),
    "address negative": (options(registers={"pv": PV | {"address": -1}}), "registers.pv.address", -1),
    "address a text": (options(registers={"pv": PV | {"address": "0"}}), "registers.pv.address", "0"),
    "no room at the end": (
        options(registers={"kp": FLOAT | {"address": 65535}}, odd_addresses=True),
        "registers.kp.address",
        65535,
    ),
    "float on an odd pair": (options(registers={"kp": FLOAT | {"address": 11}}), "registers.kp.address", 11),
    "scale 0": (options(registers={"pv": PV | {"scale": 0}}), "registers.pv.scale", 0.0),
    "scale infinite": (options(registers={"pv": PV | {"scale": float("inf")}}), "registers.pv.scale", float("inf")),
    "scale of a bit": (
        options(registers={"auto": {"table": "coil", "address": 0, "scale": 2.0}}),
        "registers.auto.scale",
        2.0,
    ),
    "overlap": (
        options(registers={"kp": FLOAT, "ti": FLOAT | {"type": "int16", "address": 11}}),
        "registers.ti.address",
        11,
    ),
    "overlap of equals": (options(registers={"set_point": OUTPUT}), "registers.set_point.address", 0),
    "invalid beyond the type": (options(registers={"pv": PV | {"invalid": [65535]}}), "registers.pv.invalid", 65535),
    "invalid not a list": (options(registers={"pv": PV | {"invalid": 3}}), "registers.pv.invalid", 3),
    "output in an input register": (
        options(registers={"output": PV | {"address": 1}}),
        "registers.output.table",
        "input",
    ),
    "no pv": (options(registers={"pv": None}), "registers.pv", None),
    "no output": (options(registers={"output": None}), "registers.output", None),
    "a register that is no table": (options(registers={"pv": 3}), "registers.pv", 3),
    "misspelt key": (options(registers={"pv": PV | {"adress": 1}}), "registers.pv.adress", 1),
    "mode of a signal without modes": (options(registers={"pv": PV | {"auto_value": 1}}), "registers.pv.auto_value", 1),
    "mode in a float": (options(registers={"auto": FLOAT}), "registers.auto.type", "float32"),
    "modes alike": (
        options(registers={"auto": OUTPUT | {"address": 5, "scale": 1, "manual_value": 1}}),
        "registers.auto.auto_value",
        1,
    ),
    "mode beyond a bit": (
        options(registers={"auto": {"table": "coil", "address": 0, "auto_value": 2}}),
        "registers.auto.auto_value",
        2,
    ),
    "value longer than a read": (
        options(registers={"kp": FLOAT}, max_registers_per_read=1),
        "registers.kp.type",
        "float32",
    ),
    "float without FC 16": (options(registers={"kp": FLOAT}, use_fc16=False), "registers.kp.type", "float32"),
    "neither FC 6 nor FC 16": (options(use_fc6=False, use_fc16=False), "use_fc16", False),
    "heartbeat that cannot be written": (
        options(registers={"heartbeat": {"table": "input", "address": 5}}),
        "registers.heartbeat.table",
        "input",
    ),
    "heartbeat that cannot count": (options(registers={"heartbeat": FLOAT}), "registers.heartbeat.type", "float32"),
    "too long reads": (options(max_registers_per_read=126), "max_registers_per_read", 126),
    "flag as number": (options(use_fc6=0), "use_fc6", 0),
    "unknown order": (options(word_order="middle"), "word_order", "middle"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_map_that_cannot_work_is_refused_by_key_value_and_remedy(case):
    values, key, value = REFUSALS[case]
    with pytest.raises(ConfigurationError) as refusal:
        read_map(Options(values))
    assert (refusal.value.field, refusal.value.value) == (key, value)
    assert refusal.value.remedy


def test_the_refusal_of_an_overlap_names_both_signals():
    with pytest.raises(ConfigurationError, match=r"registers\.ti\.address: overlaps registers\.kp"):
        read_map(Options(REFUSALS["overlap"][0]))


def test_what_a_device_allows_is_not_refused():
    odd = read_map(Options(options(registers={"kp": FLOAT | {"address": 11}}, odd_addresses=True)))
    assert odd.registers["kp"].place == "holding 11..12"
    readable = options(registers={"pv": FLOAT}, use_fc16=False)
    assert read_map(Options(readable)).registers["pv"].size == 2


def test_orders_hold_for_all_registers_unless_one_says_otherwise():
    loop_map = read_map(
        Options(
            options(registers={"kp": FLOAT, "ti": FLOAT | {"address": 12, "word_order": "big"}}, word_order="little")
        )
    )
    assert loop_map.registers["kp"].word_order == "little"
    assert loop_map.registers["ti"].word_order == "big"


@pytest.mark.parametrize(
    ("limits", "kind", "table", "single"),
    [
        (DeviceLimits(), "int16", "holding", True),
        (DeviceLimits(use_fc6=False), "int16", "holding", False),
        (DeviceLimits(), "float32", "holding", False),
        (DeviceLimits(), "bool", "coil", True),
        (DeviceLimits(use_fc5=False), "bool", "coil", False),
    ],
)
def test_the_function_code_for_one_is_used_where_it_can_be(limits, kind, table, single):
    assert limits.single(Register("x", table, 0, kind)) is single
