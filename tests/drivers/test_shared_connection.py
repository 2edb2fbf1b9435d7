"""Loops of one Modbus device share its connection, and what they read at one moment travels together. Virtual time.

The judge of a shared reading is the device itself: a table of words, with holes, a longest read, and a temper; each
loop has to see what it would see alone.
"""

import asyncio
from itertools import pairwise

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from autotuner.control.clock.ticker import Stop
from autotuner.control.driving.lease import ticker_of
from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import LineSharing
from autotuner_drivers.modbus.backend import create
from autotuner_drivers.modbus.joint_requests import JointRequests
from autotuner_drivers.modbus.protocol import Request
from autotuner_drivers.modbus.register_map import DeviceLimits

TRIP_S = 0.01
LIMIT_S = 0.5


class Device:
    """Answers after `TRIP_S`. Word `a` of a table holds 1000 and `a`; addresses of `holes` are refused.

    `temper(count)` says what becomes of a read of so many words: "answer", "refuse", "drop", "hang up" or "damage".
    """

    def __init__(self, holes=(), temper=lambda _: "answer"):
        self.holes, self.temper = set(holes), temper
        self.spans, self.words = [], {}

    async def __call__(self, device, frame, writer):
        function, address, value = frame[7], int.from_bytes(frame[8:10], "big"), int.from_bytes(frame[10:12], "big")
        await asyncio.sleep(TRIP_S)
        if function in {5, 6}:
            self.words[address] = value
            return writer.write(answer(frame, frame[7:12]))
        self.spans.append((function, address, value))
        mood = self.temper(value)
        if mood == "hang up":
            return writer.close()
        if mood == "drop":
            return None
        if mood == "refuse" or self.holes & set(range(address, address + value)):
            return writer.write(answer(frame, bytes([function | 0x80, 2])))
        words = [self.words.get(a, 1000 + a) for a in range(address, address + value)]
        if mood == "damage":
            words = words[1:]
        body = b"".join(word.to_bytes(2, "big") for word in words)
        return writer.write(answer(frame, bytes([function, len(body)]) + body))


def answer(frame, pdu):
    return frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu


def loop_at(address, **options):
    """Return a loop whose PV and output are holding registers, one after the other."""
    registers = {name: {"table": "holding", "address": address + k} for k, name in enumerate(("pv", "output"))}
    device = {"host": "device", "port": 1502, "timeout_s": LIMIT_S, "registers": registers}
    return create(device | options)


def seen_at(address):
    return {"pv": 1000.0 + address, "output": 1001.0 + address}


async def read_at_once(loops):
    """Return what each loop reads, or its error."""
    return await asyncio.gather(*(loop.read(["pv", "output"]) for loop in loops), return_exceptions=True)


@pytest.fixture
def with_loops(virtual, scripted_device):
    """Return a function that runs `use(loops, device)` with loops that are open at one device."""

    def run(script, loops, use):
        async def main():
            async with scripted_device(script).serving() as device:
                for loop in loops:
                    await loop.open()
                try:
                    return await use(loops, device)
                finally:
                    for loop in loops:
                        await loop.close()

        return virtual(main())

    return run


def test_loops_of_one_device_share_a_connection_and_a_request(with_loops):
    device = Device()

    async def use(loops, served):
        return [await read_at_once(loops) for _ in range(3)], served.connections

    seen, connections = with_loops(device, [loop_at(2 * k) for k in range(20)], use)
    assert seen == [[seen_at(2 * k) for k in range(20)]] * 3
    assert connections == 1
    assert device.spans == [(3, 0, 40)] * 3


@pytest.mark.parametrize("options", [{"connection": "own"}, {"timeout_s": 0.4}, {"unit": 3}, {"max_gap": 2}])
def test_a_loop_that_states_something_else_has_its_own(with_loops, options):
    device = Device()

    async def use(loops, served):
        return await read_at_once(loops), served.connections

    assert with_loops(device, [loop_at(0), loop_at(2, **options)], use) == ([seen_at(0), seen_at(2)], 2)


@pytest.mark.parametrize(("gap", "spans"), [(0, [(3, 0, 2), (3, 5, 2)]), (3, [(3, 0, 7)])])
def test_only_as_far_as_the_gap_allows(with_loops, gap, spans):
    device = Device()

    async def use(loops, _):
        return await read_at_once(loops)

    assert with_loops(device, [loop_at(a, max_gap=gap) for a in (0, 5)], use) == [seen_at(0), seen_at(5)]
    assert device.spans == spans


def test_what_is_requested_while_the_line_is_busy_travels_together(with_loops):
    device = Device()

    async def use(loops, _):
        first = asyncio.ensure_future(loops[0].read(["pv", "output"]))
        await asyncio.sleep(TRIP_S / 2)
        later = asyncio.ensure_future(loops[1].read(["pv", "output"]))
        await asyncio.sleep(TRIP_S / 4)
        return [await first, await later, await loops[2].read(["pv"])]

    seen = with_loops(device, [loop_at(2 * k) for k in range(3)], use)
    assert seen == [seen_at(0), seen_at(2), {"pv": 1004.0}]
    assert device.spans == [(3, 0, 2), (3, 2, 2), (3, 4, 1)]


TEMPERS = {
    "refuses long reads": lambda count: "refuse" if count > 4 else "answer",
    "drops long reads": lambda count: "drop" if count > 4 else "answer",
    "hangs up at long reads": lambda count: "hang up" if count > 4 else "answer",
    "damages long answers": lambda count: "damage" if count > 4 else "answer",
}


@pytest.mark.parametrize("temper", TEMPERS)
def test_a_device_that_answers_alone_what_it_does_not_answer_together(with_loops, temper):
    """Every loop has its values in the first reading already, and the device is asked that way once."""
    device = Device(temper=TEMPERS[temper])

    async def use(loops, _):
        seen = [await read_at_once(loops)]
        tried = len(device.spans)
        seen += [await read_at_once(loops) for _ in range(3)]
        return seen, tried, [loop.repeated for loop in loops]

    seen, tried, repeated = with_loops(device, [loop_at(2 * k) for k in range(4)], use)
    assert seen == [[seen_at(2 * k) for k in range(4)]] * 4
    assert (tried, len(device.spans)) == (5, 5 + 3 * 4)
    assert repeated == [0 if temper == "refuses long reads" else 1] * 4


def test_a_gap_that_the_device_refuses_is_crossed_once(with_loops):
    device = Device(holes={3})

    async def use(loops, _):
        return [await read_at_once(loops) for _ in range(3)]

    seen = with_loops(device, [loop_at(a, max_gap=9) for a in (0, 5, 7)], use)
    assert seen == [[seen_at(0), seen_at(5), seen_at(7)]] * 3
    assert device.spans[:4] == [(3, 0, 9), (3, 0, 2), (3, 5, 2), (3, 7, 2)]
    assert (3, 0, 9) not in device.spans[4:]


def test_a_loop_with_a_wrong_address_fails_alone(with_loops):
    """The others go on together."""
    device = Device(holes={4})

    async def use(loops, _):
        return [await read_at_once(loops) for _ in range(3)]

    for seen in with_loops(device, [loop_at(a) for a in (0, 2, 4, 6, 8)], use):
        assert isinstance(seen.pop(2), DeviceRefusedError)
        assert seen == [seen_at(0), seen_at(2), seen_at(6), seen_at(8)]
    assert device.spans[-3:] == [(3, 0, 4), (3, 4, 2), (3, 6, 4)]


@pytest.mark.parametrize("proven", [False, True])
def test_a_silent_device_costs_no_loop_more_than_its_own_time_limits(with_loops, proven):
    moods = ["answer"] * proven
    device = Device(temper=lambda _: moods.pop() if moods else "drop")

    async def use(loops, _):
        if proven:
            await read_at_once(loops)
        begun_s = asyncio.get_running_loop().time()
        errors = await read_at_once(loops)
        return errors, asyncio.get_running_loop().time() - begun_s, [loop.repeated for loop in loops]

    errors, took_s, repeated = with_loops(device, [loop_at(2 * k) for k in range(30)], use)
    assert {type(error) for error in errors} == {DeviceTimeoutError}
    assert len({id(error) for error in errors}) == 30
    assert took_s == pytest.approx(2 * LIMIT_S, abs=0.01)
    assert repeated == [1] * 30


def test_a_damaged_answer_is_repeated_for_all_and_counted_by_each(with_loops):
    moods = ["answer", "damage", "answer"]
    device = Device(temper=lambda _: moods.pop())

    async def use(loops, _):
        await read_at_once(loops)
        seen = await read_at_once(loops)
        return seen, [(loop.repeated, loop.moment_s) for loop in loops], asyncio.get_running_loop().time()

    seen, accounts, now_s = with_loops(device, [loop_at(0), loop_at(2)], use)
    assert seen == [seen_at(0), seen_at(2)]
    assert accounts == [(1, pytest.approx(now_s - TRIP_S / 2, abs=1e-3))] * 2


def test_a_loop_that_gives_up_leaves_the_answer_to_the_others(with_loops):
    async def use(loops, _):
        reads = [asyncio.ensure_future(loop.read(["pv", "output"])) for loop in loops]
        await asyncio.sleep(TRIP_S / 2)
        reads[0].cancel()
        return await asyncio.gather(*reads, return_exceptions=True)

    cancelled, *others = with_loops(Device(), [loop_at(2 * k) for k in range(3)], use)
    assert isinstance(cancelled, asyncio.CancelledError)
    assert others == [seen_at(2), seen_at(4)]


def test_a_request_that_nobody_awaits_frees_the_line_at_once(with_loops):
    """An abort cancels its reading; where it was the only one, its restore does not wait for the time limit."""
    device = Device(temper=lambda _: "drop")

    async def use(loops, _):
        clock = asyncio.get_running_loop().time
        reading = asyncio.ensure_future(loops[0].read(["pv", "output"]))
        await asyncio.sleep(0.1)
        reading.cancel()
        begun_s = clock()
        await loops[0].write({"output": 7.0})
        took_s = clock() - begun_s
        device.temper = lambda _: "answer"
        return took_s, await read_at_once(loops)

    took_s, seen = with_loops(device, [loop_at(0), loop_at(2)], use)
    assert took_s == pytest.approx(TRIP_S, abs=2e-3)
    assert seen == [{"pv": 1000.0, "output": 7.0}, seen_at(2)]


def test_a_restore_waits_for_no_more_than_the_request_under_way(with_loops):
    """Forty others have readings under way and planned, each a request of its own, at a device that is silent."""
    device = Device(temper=lambda _: "drop")

    async def use(loops, _):
        clock = asyncio.get_running_loop().time
        reads = [asyncio.ensure_future(loop.read(["pv", "output"])) for loop in loops[1:]]
        await asyncio.sleep(0.1)
        begun_s = clock()
        await loops[0].write({"output": 7.0})
        took_s = clock() - begun_s
        for read in reads:
            read.cancel()
        await asyncio.gather(*reads, return_exceptions=True)
        return took_s

    assert with_loops(device, [loop_at(5 * k) for k in range(41)], use) <= 2 * LIMIT_S + TRIP_S + 0.01
    assert device.words == {1: 7}


def test_closing_leaves_the_others_connected(with_loops):
    async def use(loops, served):
        await loops[0].close()
        with pytest.raises(LinkError, match="not open"):
            await loops[0].read(["pv"])
        with pytest.raises(LinkError, match="not open"):
            await loops[0].write({"output": 1.0})
        seen = await loops[1].read(["pv", "output"])
        await loops[0].open()
        return seen, await read_at_once(loops), served.connections

    assert with_loops(Device(), [loop_at(0), loop_at(2)], use) == (seen_at(2), [seen_at(0), seen_at(2)], 1)


def test_closing_all_ends_readings_under_way(with_loops):
    async def use(loops, _):
        reads = [asyncio.ensure_future(loop.read(["pv", "output"])) for loop in loops]
        await asyncio.sleep(0.1)
        for loop in loops:
            await loop.close()
        async with asyncio.timeout(0.1):
            return await asyncio.gather(*reads, return_exceptions=True)

    errors = with_loops(Device(temper=lambda _: "drop"), [loop_at(0), loop_at(2)], use)
    assert [type(error) for error in errors] == [LinkError, LinkError]


def test_a_lost_link_is_told_to_each_loop_and_each_comes_back(virtual, scripted_device):
    """Once by the reading under way, and by the watch of each; a device that is there again serves all."""

    async def main():
        loops, told = [loop_at(0), loop_at(2), loop_at(4)], []
        silent = Device(temper=lambda _: "drop")
        async with scripted_device(silent).serving() as served:
            for k, loop in enumerate(loops):
                await loop.open()
                loop.watch(lambda _, k=k: told.append(k))
            loops[2].watch(None)
            silent.temper = lambda _: "answer"
            await read_at_once(loops)
            silent.temper = lambda _: "drop"
            reads = asyncio.ensure_future(read_at_once(loops))
            await asyncio.sleep(TRIP_S / 2)
            served.hang_up()
            lost_s = asyncio.get_running_loop().time()
        errors = await reads
        took_s = asyncio.get_running_loop().time() - lost_s
        async with scripted_device(Device()).serving() as served:
            for loop in loops:
                await loop.close()
                await loop.open()
            seen = await read_at_once(loops)
            for loop in loops:
                await loop.close()
        return errors, took_s, told, seen, served.connections

    errors, took_s, told, seen, connections = virtual(main())
    assert all(isinstance(error, LinkError) for error in errors)
    assert took_s < 0.1
    assert sorted(set(told)) == [0, 1]
    assert seen == [seen_at(0), seen_at(2), seen_at(4)]
    assert connections == 1


def test_opening_again_mends_a_connection_that_is_open_on_one_side_only(virtual, scripted_device):
    """A firewall has forgotten it: nothing comes back, and nothing is refused. The others have the new one too."""
    device, forgotten = Device(), set()

    async def script(served, frame, writer):
        if writer not in forgotten:
            await device(served, frame, writer)
            forgotten.update([writer] if served.connections == 1 else [])

    async def main():
        async with scripted_device(script).serving() as served:
            loops = [loop_at(0), loop_at(2)]
            for loop in loops:
                await loop.open()
            before = await read_at_once(loops)
            errors = await read_at_once(loops)
            await loops[0].close()
            await loops[0].open()
            begun_s = asyncio.get_running_loop().time()
            seen = await read_at_once(loops)
            took_s = asyncio.get_running_loop().time() - begun_s
            for loop in loops:
                await loop.close()
            return before, [type(error) for error in errors], seen, took_s, served.connections

    before, errors, seen, took_s, connections = virtual(main())
    assert before == seen == [seen_at(0), seen_at(2)]
    assert errors == [DeviceTimeoutError] * 2
    assert took_s == pytest.approx(TRIP_S, abs=2e-3)
    assert connections == 2


def test_each_heartbeat_beats(with_loops):
    device = Device()
    loops = []
    for k in range(2):
        registers = {
            "pv": {"table": "holding", "address": 10 * k},
            "output": {"table": "holding", "address": 10 * k + 1},
            "heartbeat": {"table": "holding", "address": 10 * k + 2, "type": "uint16"},
        }
        loops.append(create({"host": "device", "port": 1502, "registers": registers}))

    async def use(loops, _):
        for _ in range(3):
            await read_at_once(loops)
        return dict(device.words)

    assert with_loops(device, loops, use) == {2: 3, 12: 3}
    assert device.words == {2: 0, 12: 0}


def test_two_loops_may_read_the_same_register(with_loops):
    device = Device()

    async def use(loops, _):
        return await read_at_once(loops)

    assert with_loops(device, [loop_at(0), loop_at(1), loop_at(0)], use) == [seen_at(0), seen_at(1), seen_at(0)]
    assert device.spans == [(3, 0, 3)]


def test_periods_of_loops_on_one_device_begin_together(with_loops):
    """The first one waits for nothing; whoever comes later ticks with it, and one on a device of its own at once."""

    async def use(loops, _):
        clock, begun = asyncio.get_running_loop().time, asyncio.get_running_loop().time()

        async def ticks(loop, after_s, period_s):
            await asyncio.sleep(after_s)
            ticker, seen = ticker_of(loop, period_s), []
            for _ in range(3):
                tick = await ticker.tick(Stop())
                seen.append(round(clock() - begun, 3))
                assert (tick.lateness_s, tick.missed) == (pytest.approx(0.0, abs=1e-5), 0)
            return seen

        assert all(isinstance(loop, LineSharing) for loop in loops)
        plan = zip(loops, (0.02, 0.05, 0.12, 0.05), (0.1, 0.1, 0.2, 0.1), strict=True)
        return await asyncio.gather(*(ticks(*one) for one in plan))

    loops = [loop_at(0), loop_at(2), loop_at(4), loop_at(6, connection="own")]
    assert with_loops(Device(), loops, use) == [
        [0.02, 0.12, 0.22],
        [0.12, 0.22, 0.32],
        [0.22, 0.42, 0.62],
        [0.05, 0.15, 0.25],
    ]


REQUESTS = st.lists(
    st.builds(
        Request, st.sampled_from([1, 3, 4]), st.integers(0, 60), st.integers(1, 8), unit=st.sampled_from([None, 5])
    ),
    min_size=1,
    max_size=12,
)


@given(requests=REQUESTS, gap=st.integers(0, 5), longest=st.integers(8, 30))
def test_joint_requests_hold_each_request_within_the_limits(requests, gap, longest):
    planner = JointRequests(DeviceLimits(max_registers_per_read=longest, max_bits_per_read=longest, max_gap=gap))
    joints = planner.joined(requests)
    assert sorted(part for joint in joints for part in joint.parts) == list(range(len(requests)))
    for joint in joints:
        held = {a for part in joint.parts for a in addresses(requests[part])}
        asked = set(addresses(joint.request))
        assert held <= asked
        assert min(held) == min(asked)
        assert max(held) == max(asked)
        assert len(asked) <= longest
        assert {requests[part][0] for part in joint.parts} == {joint.request.function}
        assert {requests[part].unit for part in joint.parts} == {joint.request.unit}
        runs = sorted(held)
        assert all(after - before - 1 <= gap for before, after in pairwise(runs))


def addresses(request):
    return range(request.address, request.address + request.count)


LAYOUTS = st.lists(st.integers(0, 25), min_size=2, max_size=6)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    places=LAYOUTS,
    holes=st.sets(st.integers(0, 30), max_size=4),
    longest=st.integers(2, 12),
    mood=st.sampled_from(["refuse", "drop", "hang up", "damage"]),
    gap=st.integers(0, 4),
)
def test_each_loop_sees_what_it_would_see_alone(virtual, scripted_device, places, holes, longest, mood, gap):
    """Whatever the device refuses, drops or damages: three readings of loops that share, against loops that do not."""

    async def read(connection):
        script = Device(holes, lambda count: mood if count > longest else "answer")
        async with scripted_device(script).serving():
            loops = [loop_at(place, max_gap=gap, connection=connection) for place in places]
            for loop in loops:
                await loop.open()
            readings = [await read_at_once(loops) for _ in range(3)]
            for loop in loops:
                await loop.close()
        return [[one if isinstance(one, dict) else type(one) for one in reading] for reading in readings]

    async def main():
        return await read("shared"), await read("own")

    shared, own = virtual(main())
    assert shared == own
    for one, place in zip(own[0], places, strict=True):
        assert one == seen_at(place) if isinstance(one, dict) else issubclass(one, DriverError)
