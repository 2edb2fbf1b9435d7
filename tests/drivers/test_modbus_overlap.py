"""Requests that overlap on a slow Modbus TCP line; the device answers each after a time of its own. Virtual time."""

import asyncio
import logging

import pytest

from autotuner.errors import DeviceRefusedError, DriverError, LinkError
from autotuner_drivers.modbus.backend import create

TRIP_S = 0.2
PAUSE_S = 2.0
REGISTERS = {
    "pv": {"table": "input", "address": 0},
    "output": {"table": "holding", "address": 0},
    "far": {"table": "holding", "address": 50},
    "auto": {"table": "coil", "address": 7},
}
VALUES = {"pv": 300.0, "output": 200.0, "far": 250.0, "auto": 1.0}


def answer_of(frame):
    """Return the answer: input registers hold 300 and their address, holding registers 200 and theirs, coils 1."""
    function, address = frame[7], int.from_bytes(frame[8:10], "big")
    word = ({4: 300, 3: 200}.get(function, 0) + address).to_bytes(2, "big")
    pdu = {1: b"\x01\x01\x01", 5: frame[7:12], 6: frame[7:12]}.get(function, bytes([function, 2]) + word)
    return frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu


class Line:
    """Answers each request after `delays` of its turn, s; requests that come while one is answered go to `busy`."""

    def __init__(self, delays=(2 * TRIP_S,), busy=None):
        self.delays, self.busy, self.turn, self.under_way, self.most = delays, busy, 0, 0, 0
        self.tasks = set()

    async def __call__(self, device, frame, writer):
        if self.under_way and self.busy is not None:
            self.busy(writer)
            return
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        delay_s = self.delays[self.turn % len(self.delays)]
        self.turn += 1
        task = asyncio.ensure_future(self.later(delay_s, frame, writer))
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def later(self, delay_s, frame, writer):
        await asyncio.sleep(delay_s)
        self.under_way -= 1
        writer.write(answer_of(frame))


@pytest.fixture
def readings(virtual, scripted_device):
    """Return a function that opens a device behind a line and reads it: each reading and how long it took, s."""

    def read(line, count=4, registers=REGISTERS, **options):
        async def main():
            clock = asyncio.get_running_loop().time
            device = {"host": "device", "port": 1502, "registers": registers} | options
            async with scripted_device(line).serving():
                backend = create(device)
                await backend.open()
                made = []
                for _ in range(count):
                    begun = clock()
                    try:
                        values = await backend.read([name for name in registers if name != "heartbeat"])
                    except DriverError as error:
                        values = error
                    made.append((values, clock() - begun, backend.moment_s - begun))
                    await asyncio.sleep(PAUSE_S)
                await backend.close()
            return made

        return virtual(main())

    return read


def test_on_a_slow_line_a_reading_lasts_one_round_trip(readings):
    line = Line()
    first, *others = readings(line)
    assert first[1] == pytest.approx(2 * 2 * TRIP_S, abs=0.01)  # the first answer shows that the line is slow
    for values, took_s, moment_s in others:
        assert values == VALUES
        assert took_s == pytest.approx(2 * TRIP_S, abs=0.01)
        assert moment_s == pytest.approx(TRIP_S, abs=0.01)
    assert line.most == 4


def test_answers_in_any_order_belong_to_their_requests(readings):
    line = Line(delays=(0.4, 0.1, 0.3, 0.2, 0.05))
    assert [values for values, *_ in readings(line, count=20)] == [VALUES] * 20
    assert line.most > 1


def test_a_fast_line_and_a_device_that_is_set_so_are_asked_one_after_another(readings):
    for line, options in ((Line(delays=(0.01,)), {}), (Line(), {"overlap": 1}), (Line(), {"retries": 0})):
        assert [values for values, *_ in readings(line, **options)] == [VALUES] * 4
        assert line.most == 1


def test_no_more_than_so_many(readings):
    line = Line()
    took_s = [took_s for _, took_s, _ in readings(line, overlap=3)]
    assert took_s[1:] == pytest.approx([4 * TRIP_S] * 3, abs=0.01)
    assert line.most == 3


def test_a_device_that_drops_what_comes_while_it_is_busy_is_asked_one_after_another(readings, caplog):
    caplog.set_level(logging.WARNING)
    made = readings(Line(busy=lambda _: None), count=3)
    assert [values for values, *_ in made] == [VALUES] * 3
    # the first alone, one of three, the time limit of 1 s for the two that were dropped, then each of them alone
    assert [took_s for _, took_s, _ in made] == pytest.approx([0.4 + 1.0 + 2 * 0.4, 1.6, 1.6], abs=0.01)
    assert caplog.text.count("requests are sent one after another") == 1


def test_a_device_that_hangs_up_when_it_is_busy_is_asked_one_after_another(readings):
    made = readings(Line(busy=lambda writer: writer.close()), count=5)
    kinds = [type(values) for values, *_ in made]
    assert kinds == [LinkError, LinkError, dict, dict, dict]


def test_an_answer_that_comes_late_is_never_taken_for_another(readings):
    made = readings(Line(delays=(0.4,) * 4 + (1.3, 0.4, 0.4, 0.4)), count=3)
    assert [values for values, *_ in made] == [VALUES] * 3


def test_a_refusal_among_several(virtual, scripted_device):
    async def script(device, frame, writer):
        await asyncio.sleep(TRIP_S)
        refused = frame[7] == 4 and len(device.requests) > 2
        writer.write(frame[:4] + b"\x00\x03" + frame[6:7] + b"\x84\x02" if refused else answer_of(frame))

    async def main():
        async with scripted_device(script).serving():
            backend = create({"host": "device", "port": 1502, "registers": REGISTERS})
            await backend.open()
            await backend.read(["pv"])
            await backend.read(["output"])
            with pytest.raises(DeviceRefusedError, match="illegal data address"):
                await backend.read(["pv", "auto"])
            assert await backend.read(["output"]) == {"output": 200.0}
            await backend.close()

    virtual(main())


def test_a_write_does_not_wait_for_the_whole_of_a_slow_reading(virtual, scripted_device):
    async def main():
        async with scripted_device(Line()).serving() as device:
            backend = create({"host": "device", "port": 1502, "registers": REGISTERS, "overlap": 1})
            await backend.open()
            reading = asyncio.ensure_future(backend.read(list(REGISTERS)))
            await asyncio.sleep(0.1)
            await backend.write({"output": 1.0})
            await reading
            await backend.close()
            return [frame[7] for frame in device.requests]

    assert virtual(main()).index(6) == 1


def test_the_heartbeat_goes_along(readings):
    line = Line()
    registers = REGISTERS | {"heartbeat": {"table": "holding", "address": 90, "type": "uint16"}}
    made = readings(line, registers=registers, overlap=5)
    assert [values for values, *_ in made] == [VALUES] * 4
    assert [took_s for _, took_s, _ in made][1:] == pytest.approx([2 * TRIP_S] * 3, abs=0.01)
