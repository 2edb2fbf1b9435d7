"""The serial driver with a TCLab board in memory, in virtual time: late, lost and damaged bytes, reset and unplug."""

import asyncio
from functools import reduce
from operator import xor

import pytest
from numpy.random import default_rng

from autotuner.control.clock.ticker import Ticker
from autotuner.control.devices.retrying import persistently
from autotuner.errors import (
    ConfigurationError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DriverError,
    InputError,
    LinkError,
)
from autotuner.ports import Backend
from autotuner_drivers.serial.backend import SerialBackend, create
from autotuner_drivers.serial.bisynch import Bisynch
from autotuner_drivers.serial.lakeshore import LakeShore
from autotuner_drivers.serial.link import SerialLink, Timing
from autotuner_drivers.serial.open_line import Frame
from autotuner_drivers.serial.port import SerialSettings
from autotuner_drivers.serial.tclab import TcLab
from autotuner_sim.coupled import coupled_plants
from autotuner_sim.devices.tclab_board import TclabBoard
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant


class MemoryPort:
    """A port to a board; `outward` and `homeward` may change what passes, `lateness` says when the answer arrives."""

    def __init__(self, outward=bytes, homeward=bytes, lateness=lambda: 0.01):
        self.plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), pv0=23.0, output_limits=(0.0, 100.0))
        self.board = TclabBoard(self.plant)
        self.outward, self.homeward, self.lateness = outward, homeward, lateness
        self.opened = 0
        self.plugged, self.is_open = True, False
        self._arriving = []
        self.sent = []

    async def open(self):
        if not self.plugged:
            raise FileNotFoundError(2, "no such port")
        self.opened += 1
        self.is_open = True
        self._advance()
        self.board.reset()

    async def write(self, message):
        self._check()
        self._advance()
        self.sent.append(message)
        answer = self.homeward(self.board.receive(self.outward(message)))
        if answer:
            self._arriving.append((asyncio.get_running_loop().time() + self.lateness(), answer))

    async def read(self, wait_s):
        self._check()
        await asyncio.sleep(min(wait_s, 0.02))
        return self._arrived()

    async def clear(self):
        self._check()
        self._arrived()

    async def close(self):
        self.is_open = False
        self._arriving.clear()

    def _arrived(self):
        now = asyncio.get_running_loop().time()
        ready = [answer for at, answer in self._arriving if at <= now]
        self._arriving = [(at, answer) for at, answer in self._arriving if at > now]
        return b"".join(ready)

    def _advance(self):
        self.board.advance(asyncio.get_running_loop().time())

    def _check(self):
        if not (self.plugged and self.is_open):
            raise OSError(5, "the port is gone")


def backend(port, *, retries=0, timeout_s=0.5, late_answer_s=0.5):
    protocol = TcLab(1, 200.0, 3, read_back=True)
    timing = Timing(timeout_s, late_answer_s, 0.05, protocol.pause_s)
    return SerialBackend(SerialLink(port, "ttyLAB", timing, protocol.split), protocol, retries)


def test_it_is_a_backend():
    assert isinstance(backend(MemoryPort()), Backend)


def test_reads_and_writes(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 40.0})
        await asyncio.sleep(100.0)
        seen = await loop.read(["pv", "output"])
        await loop.close()
        return seen, loop.latency_s

    seen, latency_s = virtual(main())
    assert seen == {"pv": pytest.approx(103.0, abs=0.01), "output": 40.0}
    assert 0.01 <= latency_s <= 0.03


def test_opening_waits_for_the_board_and_is_idempotent(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port)
        await loop.open()
        took_s = asyncio.get_running_loop().time()
        await loop.open()
        await loop.close()
        await loop.close()
        await loop.open()
        await loop.close()
        return took_s, port.opened

    took_s, opened = virtual(main())
    assert 2.0 <= took_s < 3.0
    assert opened == 2


def test_a_board_that_is_still_deaf_is_asked_again(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port, retries=3)
        loop._protocol.settle_s = 0.1
        await loop.open()
        await loop.close()

    virtual(main())


@pytest.mark.parametrize("seed", range(2))
def test_late_answers_are_never_taken_for_the_next(virtual, seed):
    """The heater stands at 77 and the plant at rest, so an answer in the wrong place shows."""
    random_ = default_rng(seed)

    async def main():
        port = MemoryPort()
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 77.0})
        port.board.temperature = lambda _: 23.0
        port.lateness = lambda: 0.8 if random_.random() < 0.1 else 0.01
        wrong, values = [], 0
        for _ in range(1000):
            name, right = ("pv", 23.0) if random_.random() < 0.5 else ("output", 77.0)
            try:
                seen = (await loop.read([name]))[name]
            except LinkError:
                continue
            values += 1
            if seen != right:
                wrong.append((name, seen))
        await loop.close()
        return values, wrong

    values, wrong = virtual(main())
    assert wrong == []
    assert values > 500


def test_a_damaged_command_that_switched_the_heater_off_is_noticed_and_made_good(virtual):
    damage = iter([False] * 6 + [True] + [False] * 100)

    def outward(message):
        return b"S1\n" if next(damage) else message

    async def main():
        port = MemoryPort(outward=outward)
        loop = backend(port, retries=1)
        await loop.open()
        await loop.write({"output": 40.0})
        await loop.read(["pv"])
        before = port.plant.output
        await loop.read(["pv"])
        after = port.plant.output
        await loop.close()
        return before, after, port.board.misunderstood, port.sent[-6:]

    before, after, misunderstood, sent = virtual(main())
    assert (before, after) == (40.0, 40.0)
    assert misunderstood == 1
    assert sent == [b"T1\n", b"Q1 40.000\n", b"P1 200.00\n", b"R1\n", b"T1\n", b"R1\n"]


def test_without_repetitions_it_is_an_error_and_made_good_by_the_next_call(virtual):
    damage = iter([False] * 4 + [True] + [False] * 100)

    async def main():
        port = MemoryPort(outward=lambda message: b"S1\n" if next(damage) else message)
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 40.0})
        with pytest.raises(LinkError, match=r"sent b'S1.*instead of an answer"):
            await loop.read(["pv"])
        off = port.plant.output
        seen = await loop.read(["pv", "output"])
        await loop.close()
        return off, seen["output"]

    assert virtual(main()) == (0.0, 40.0)


@pytest.mark.parametrize("rate", [0.005, 0.02])
def test_damaged_bytes_both_ways_never_leave_the_heater_off(virtual, rate):
    """After each successful call the heater stands where it was set, however often it was switched off in between."""
    random_ = default_rng(5)

    def damaged(message):
        return bytes(b ^ (1 << int(random_.integers(7))) if random_.random() < rate else b for b in message)

    async def main():
        port = MemoryPort(outward=damaged, homeward=damaged)
        loop = backend(port, retries=10)
        await loop.open()
        await loop.write({"output": 40.0})
        loop._retries = 3
        good, off = 0, 0
        for _ in range(500):
            await asyncio.sleep(0.1)
            try:
                await loop.read(["pv"])
            except DriverError:
                continue
            good += 1
            off += port.plant.output != 40.0
        await loop.close()
        return good, off, port.board.misunderstood

    good, off, misunderstood = virtual(main())
    assert good > 400
    assert misunderstood > 0
    assert off == 0


def test_an_output_that_the_board_took_back_by_itself_is_an_error_and_stays_off(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port, retries=2)
        await loop.open()
        await loop.write({"output": 40.0})
        port.board.stop()
        with pytest.raises(DeviceRefusedError, match="holds 0 where 40 was set"):
            await loop.read(["pv"])
        with pytest.raises(DeviceRefusedError, match="holds 0 where 40 was set"):
            await loop.read(["pv"])
        off = port.plant.output
        await loop.write({"output": 0.0})
        seen = await loop.read(["output"])
        await loop.close()
        return off, seen

    assert virtual(main()) == (0.0, {"output": 0.0})


def test_one_damaged_digit_of_the_read_back_is_asked_for_again(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 40.0})
        port.homeward = lambda _: b"48.000\r\n"
        with pytest.raises(DeviceRefusedError, match="holds 48"):
            await loop.read(["output"])
        once = iter([b"48.000\r\n"])
        port.homeward = lambda answer: next(once, answer)
        seen = await loop.read(["output"])
        await loop.close()
        return seen

    assert virtual(main()) == {"output": 40.0}


def test_a_board_that_was_unplugged_gets_its_output_back(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 40.0})
        port.plugged = False
        with pytest.raises(LinkError) as first:
            await loop.read(["pv"])
        with pytest.raises(LinkError) as second:
            await loop.read(["pv"])
        await asyncio.sleep(5.0)
        port.plugged = True
        port._advance()
        port.board.reset()
        off = port.plant.output
        seen = await loop.read(["output"])
        on = port.plant.output
        await loop.close()
        return first.value.__cause__, second.value.__cause__, off, seen, on

    lost, absent, off, seen, on = virtual(main())
    assert isinstance(lost, OSError)
    assert isinstance(absent, FileNotFoundError)
    assert (off, seen, on) == (0.0, {"output": 40.0}, 40.0)


def test_a_silent_board_is_given_up_in_time(virtual):
    async def main():
        port = MemoryPort()
        loop = backend(port, retries=2)
        await loop.open()
        port.homeward = lambda _: b""
        start = asyncio.get_running_loop().time()
        with pytest.raises(DeviceTimeoutError, match=r"ttyLAB did not answer within 0\.5 s"):
            await loop.read(["pv"])
        took_s = asyncio.get_running_loop().time() - start
        await loop.close()
        return took_s

    assert virtual(main()) <= 3 * 0.5 + 2 * 0.5 + 0.2


def test_a_cancelled_read_leaves_the_line_usable(virtual):
    async def main():
        port = MemoryPort(lateness=lambda: 0.2)
        loop = backend(port)
        await loop.open()
        await loop.write({"output": 77.0})
        port.board.temperature = lambda _: 23.0
        for _ in range(20):
            under_way = asyncio.create_task(loop.read(["output"]))
            await asyncio.sleep(0.1)
            under_way.cancel()
            await asyncio.gather(under_way, return_exceptions=True)
            assert await loop.read(["pv"]) == {"pv": 23.0}
        await loop.close()

    virtual(main())


def test_an_unasked_line_is_passed_over(virtual):
    async def main():
        port = MemoryPort(homeward=lambda answer: b"High Temp 1 (>100C): \r\n" + answer if answer else b"")
        loop = backend(port)
        await loop.open()
        port.board.temperature = lambda _: 23.0
        seen = await loop.read(["pv"])
        await loop.close()
        return seen

    assert virtual(main()) == {"pv": 23.0}


def test_calls_before_opening_and_signals_that_are_none(virtual):
    async def main():
        loop = backend(MemoryPort())
        with pytest.raises(LinkError, match="not open"):
            await loop.read(["pv"])
        with pytest.raises(InputError, match="can write"):
            await loop.write({"pv": 1.0})
        with pytest.raises(DeviceRefusedError, match="finite"):
            await loop.write({"output": float("nan")})

    virtual(main())


@pytest.mark.parametrize(
    ("changes", "key", "value"),
    [
        ({"protocol": "marlin"}, "protocol", "marlin"),
        ({"protocol": None}, "protocol", None),
        ({"serial_port": None}, "serial_port", None),
        ({"channel": 3}, "channel", 3),
        ({"parity": "mark"}, "parity", "mark"),
        ({"timeout_s": "1 s"}, "timeout_s", "1 s"),
        ({"retries": -1}, "retries", -1),
        ({"sensor": "A"}, "sensor", "A"),
        ({"protocol": "lakeshore", "sensor": "E"}, "sensor", "E"),
        ({"protocol": "lakeshore", "heater_range": 0}, "heater_range", 0),
        ({"protocol": "eurotherm", "unit": 10}, "unit", 10),
        ({"protocol": "eurotherm", "valid": [5.0]}, "valid", [5.0]),
        ({"protocol": "template"}, "signals", None),
    ],
)
def test_options_that_cannot_work_are_refused_by_key_value_and_remedy(changes, key, value):
    options = {"protocol": "tclab", "serial_port": "/dev/ttyACM0"} | changes
    with pytest.raises(ConfigurationError) as refusal:
        create({name: option for name, option in options.items() if option is not None})
    assert refusal.value.field == key
    assert refusal.value.remedy
    if value is not None:
        assert refusal.value.value == value


@pytest.mark.parametrize(("protocol", "disturbs"), [("tclab", True), ("lakeshore", False), ("eurotherm", False)])
def test_opening_the_port_resets_a_tclab_only(protocol, disturbs):
    options = {"eurotherm": {"unit": 1}}.get(protocol, {})
    assert create({"protocol": protocol, "serial_port": "/dev/ttyACM0", **options}).opening_disturbs is disturbs


class LakeShorePort:
    """A port to a controller whose heater is off; remembers when each command came."""

    def __init__(self):
        self.held, self.range, self.came_s, self._answer = 0.0, 0, {}, b""

    async def open(self):
        pass

    async def close(self):
        pass

    async def clear(self):
        self._answer = b""

    async def write(self, message):
        command, _, rest = message.decode().strip().partition(" ")
        self.came_s[message.decode().strip()] = asyncio.get_running_loop().time()
        if command == "MOUT":
            self.held = float(rest.partition(",")[2])
        elif command == "RANGE":
            self.range = int(rest.partition(",")[2])
        else:
            told = {"*IDN?": "LSCI,MODEL335,PEER,1.0", "MOUT?": f"{self.held:+.2f}", "RANGE?": str(self.range)}
            self._answer = f"{told[command]}\r\n".encode()

    async def read(self, wait_s):
        await asyncio.sleep(min(wait_s, 0.02))
        answer, self._answer = self._answer, b""
        return answer


def test_an_output_counts_from_when_the_heater_is_switched_on(virtual):
    """Four commands with a pause before each: it was set 0.2 s before, to a heater that was off."""

    async def main():
        port, protocol = LakeShorePort(), LakeShore("A", 1, "celsius", 3)
        loop = SerialBackend(SerialLink(port, "ttyLS", Timing(0.5, 0.5, 0.05, 0.05), protocol.split), protocol, 0)
        await loop.open()
        await loop.write({"output": 30.0})
        first_s = loop.moment_s
        await loop.write({"output": 40.0})
        await loop.close()
        return first_s, loop.moment_s, port.came_s

    first_s, second_s, came_s = virtual(main())
    assert came_s["RANGE 1,3"] - came_s["MOUT 1,30.00"] > 0.1
    assert first_s == pytest.approx(came_s["RANGE 1,3"], abs=1e-6)
    assert second_s == pytest.approx(came_s["MOUT 1,40.00"], abs=1e-6)


class EchoingEurotherm(LakeShorePort):
    """A two-wire line to a controller at 01 with PV 23.5: what is sent comes back first, some of it with the answer."""

    def __init__(self):
        super().__init__()
        self._owed = []

    async def clear(self):
        self._owed = []

    async def write(self, message):
        data = {b"PV": b"PV  23.5", b"SW": b"SW>8000"}[message[5:7]] + b"\x03"
        whole = message + b"\x02" + data + bytes([reduce(xor, data)])
        self._owed = [whole[:1], whole[1:5], b"", b"", b"", b"", whole[5:]]

    async def read(self, wait_s):
        await asyncio.sleep(min(wait_s, 0.02))
        return self._owed.pop(0) if self._owed else b""


def euro_line(*, echo):
    protocol = Bisynch(0, 1, 1, (-1999.0, 9998.0))
    timing = Timing(0.5, 0.5, 0.05, protocol.pause_s, echo)
    return SerialBackend(SerialLink(EchoingEurotherm(), "tty485", timing, protocol.split), protocol, 0)


def test_an_echo_is_no_answer(virtual):
    """The first byte of a poll means, from the device, that there is no such parameter."""

    async def main(*, echo):
        loop = euro_line(echo=echo)
        await loop.open()
        try:
            return await loop.read(["pv"])
        finally:
            await loop.close()

    assert virtual(main(echo=True)) == {"pv": 23.5}
    with pytest.raises(DriverError, match="echo = true"):
        virtual(main(echo=False))


@pytest.mark.parametrize("plugged", [True, False])
def test_a_way_back_over_a_dead_line_ends_at_its_limit(virtual, plugged):
    """Silent or pulled out; an attempt with its repetitions and the wait for a late answer takes twelve seconds."""

    async def main():
        port = MemoryPort()
        loop = backend(port, retries=2, timeout_s=2.0, late_answer_s=2.0)
        await loop.open()
        port.homeward, port.plugged = (lambda _answer: b""), plugged
        begun_s, tries = asyncio.get_running_loop().time(), []

        async def attempt():
            await loop.open()
            await loop.write({"output": 0.0})

        assert await persistently(attempt, Ticker(0.1), tries.append, 30.0) is None
        took_s = asyncio.get_running_loop().time() - begun_s
        await loop.close()
        return took_s, len(tries)

    took_s, tries = virtual(main())
    assert took_s == pytest.approx(30.0, abs=2e-3)
    assert tries >= 2


def both_channels(port, baudrate=115200):
    """Return closed backends of both heaters of one board, which share its port."""
    port.plant, second = coupled_plants(pv0=(23.0, 23.0), limits=(0.0, 100.0))
    port.board = TclabBoard(port.plant, second)
    timing = Timing(0.5, 0.5, 0.05, 0.0)
    loops = []
    for channel, duty in ((1, 200.0), (2, 100.0)):
        protocol = TcLab(channel, duty, 3, read_back=True)
        settings = SerialSettings("ttyLAB", baudrate if channel == 2 else 115200, 8, "N", 1)
        link = SerialLink(port, "ttyLAB", timing, protocol.split)
        loops.append(SerialBackend(link, protocol, 1, Frame(settings, "tclab", timing)))
    return loops


def test_both_channels_of_a_board_share_its_port(virtual):
    async def main():
        port = MemoryPort()
        first, second = both_channels(port)
        await first.open()
        await first.write({"output": 40.0})
        await second.open()
        await asyncio.gather(first.write({"output": 50.0}), second.write({"output": 30.0}))
        seen = await asyncio.gather(*(loop.read(["pv", "output"]) for loop in (first, second) for _ in range(20)))
        await first.close()
        with pytest.raises(LinkError, match="not open"):
            await first.read(["output"])
        left = await second.read(["output"]), port.opened, port.is_open
        await second.close()
        return seen, left, port.is_open

    seen, left, still_open = virtual(main())
    assert [one["output"] for one in seen] == [50.0] * 20 + [30.0] * 20
    assert left == ({"output": 30.0}, 1, True)
    assert not still_open


def test_what_a_damaged_command_of_one_channel_switched_off_the_other_sets_again(virtual):
    async def main():
        port = MemoryPort()
        first, second = both_channels(port)
        await first.open()
        await second.open()
        await first.write({"output": 40.0})
        await second.write({"output": 30.0})
        damaged = iter([True])
        port.outward = lambda message: message.replace(b"T", b"S") if next(damaged, False) else message
        await second.read(["pv"])
        misunderstood, off = port.board.misunderstood, port.board.heater(0)
        await first.read(["pv"])
        heaters = [port.board.heater(channel) for channel in (0, 1)]
        await first.close()
        await second.close()
        return misunderstood, off, heaters

    assert virtual(main()) == (1, 0.0, [40.0, 30.0])


def test_channels_of_one_port_must_agree_on_its_frame(virtual):
    async def main():
        first, second = both_channels(MemoryPort(), baudrate=9600)
        await first.open()
        try:
            with pytest.raises(LinkError, match="other settings"):
                await second.open()
            return await first.read(["output"])
        finally:
            await first.close()
            await second.close()

    assert virtual(main()) == {"output": 0.0}
