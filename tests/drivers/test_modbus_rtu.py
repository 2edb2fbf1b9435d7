"""RTU framing through our client in virtual time: late, garbled, echoed and foreign answers.

The line is a byte stream to a slave that serves one request after another, as a real one does. Each register holds 1000
plus its address, so a value that was attributed to the wrong register shows.
"""

import asyncio
import contextlib

import pytest
from numpy.random import default_rng
from pymodbus.framer.rtu import FramerRTU

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner_drivers.modbus.backend import create

UNIT = 7
ADDRESSES = (0, 2, 4, 6, 8, 20, 22, 24)


class Slave:
    """An RTU slave at the far end of a stream.

    `lateness()` says how long each answer takes; `damage(answer)` may change it, or drop it by returning nothing.
    """

    def __init__(self, lateness=lambda: 0.01, damage=lambda answer: answer, *, echo=False):
        self.lateness, self.damage, self.echo = lateness, damage, echo
        self.requests = []

    @contextlib.asynccontextmanager
    async def serving(self):
        clients = []

        async def serve(reader, writer):
            clients.append((asyncio.current_task(), writer))
            with contextlib.suppress(asyncio.IncompleteReadError, asyncio.CancelledError, ConnectionError):
                while True:
                    frame = await reader.readexactly(8)
                    if frame[1] == 16:
                        frame += await reader.readexactly(frame[6] + 1)
                    self.requests.append(frame)
                    if self.echo:
                        writer.write(frame)
                    await asyncio.sleep(self.lateness())
                    writer.write(self.damage(answer_to(frame)) or b"")

        server = await asyncio.start_server(serve, "gateway", 4001)
        try:
            yield self
        finally:
            server.close()
            for task, writer in clients:
                task.cancel()
                writer.close()
            await asyncio.sleep(2.0)


def answer_to(frame: bytes) -> bytes:
    address, count = int.from_bytes(frame[2:4], "big"), int.from_bytes(frame[4:6], "big")
    if frame[1] in {3, 4}:
        words = b"".join((1000 + address + i).to_bytes(2, "big") for i in range(count))
        return sealed(frame[:2] + bytes([len(words)]) + words)
    return sealed(frame[:6])


def sealed(content: bytes) -> bytes:
    return content + FramerRTU.compute_CRC(content).to_bytes(2, "big")


def backend(**options):
    registers = {f"r{a}": {"table": "input" if a < 20 else "holding", "address": a} for a in ADDRESSES}
    registers |= {"pv": {"table": "input", "address": 40}, "output": {"table": "holding", "address": 50}}
    line = {"transport": "rtu_over_tcp", "host": "gateway", "port": 4001, "unit": UNIT}
    return create(line | {"timeout_s": 0.5, "retries": 0, "registers": registers} | options)


async def mixed_reads(count: int, seed: int, **options) -> tuple[int, list[str]]:
    """Read single registers in random order; return the number of values and the wrong ones."""
    loop, random_ = backend(**options), default_rng(seed)
    await loop.open()
    values, wrong = 0, []
    for _ in range(count):
        address = ADDRESSES[random_.integers(len(ADDRESSES))]
        with contextlib.suppress(LinkError):
            seen = (await loop.read([f"r{address}"]))[f"r{address}"]
            values += 1
            if seen != 1000 + address:
                wrong.append(f"register {address} read {seen}")
    await loop.close()
    return values, wrong


@pytest.mark.one_of(2)
@pytest.mark.parametrize("seed", range(3))
def test_replies_0_8_s_late_are_never_attributed_to_another_register(virtual, seed):
    """A thousand mixed reads at a time limit of 0.5 s; three replies in ten come after 0.8 s."""
    random_ = default_rng(seed)

    async def main():
        async with Slave(lateness=lambda: 0.8 if random_.random() < 0.3 else 0.02).serving():
            return await mixed_reads(1000, seed)

    values, wrong = virtual(main())
    assert wrong == []
    assert 600 < values < 800


def test_a_slave_that_is_always_late_gives_no_value_at_all(virtual):
    async def main():
        async with Slave(lateness=lambda: 0.8).serving():
            return await mixed_reads(200, 1)

    assert virtual(main()) == (0, [])


def test_without_the_watch_late_replies_would_be_attributed_wrongly(virtual):
    """The control: patience that ends with the time limit lets them through, so the tests above are able to fail."""
    random_ = default_rng(1)

    async def main():
        async with Slave(lateness=lambda: 0.8 if random_.random() < 0.3 else 0.02).serving():
            return await mixed_reads(300, 1, late_answer_s=0.0, gap_s=0.001)

    _, wrong = virtual(main())
    assert len(wrong) > 10


def test_cancelled_reads_do_not_leave_their_answers_behind(virtual):
    async def main():
        async with Slave(lateness=lambda: 0.2).serving():
            loop = backend()
            await loop.open()
            wrong = []
            for k in range(100):
                under_way = asyncio.create_task(loop.read([f"r{ADDRESSES[k % 5]}"]))
                await asyncio.sleep(0.1)
                under_way.cancel()
                await asyncio.gather(under_way, return_exceptions=True)
                seen = await loop.read(["r8"])
                if seen != {"r8": 1008.0}:
                    wrong.append(seen)
            await loop.close()
            return wrong

    assert virtual(main()) == []


def test_a_late_answer_frees_the_line_without_waiting_for_the_end_of_patience(virtual):
    delays = iter([0.8] + [0.02] * 10)

    async def main():
        async with Slave(lateness=lambda: next(delays)).serving():
            loop = backend(late_answer_s=30.0)
            await loop.open()
            with pytest.raises(DeviceTimeoutError):
                await loop.read(["r0"])
            value = await loop.read(["r2"])
            took_s = asyncio.get_running_loop().time()
            await loop.close()
            return value, took_s

    value, took_s = virtual(main())
    assert value == {"r2": 1002.0}
    assert took_s < 1.0


@pytest.mark.parametrize(
    "spoil",
    [
        lambda answer: answer[:-1] + bytes([answer[-1] ^ 1]),
        lambda answer: bytes([answer[0] ^ 4]) + answer[1:],
        lambda answer: answer[:3] + bytes([answer[3] ^ 128]) + answer[4:],
        lambda answer: b"\xff" * len(answer),
    ],
    ids=["checksum", "unit", "value", "all"],
)
def test_a_garbled_answer_is_noticed_by_its_silence_and_asked_for_again(virtual, spoil):
    garbled = iter([True, False, True, True, False])

    async def main():
        async with Slave(damage=lambda answer: spoil(answer) if next(garbled) else answer).serving():
            loop = backend(retries=2, timeout_s=10.0)
            await loop.open()
            values = [await loop.read(["r4"]), await loop.read(["r6"])]
            took_s = asyncio.get_running_loop().time()
            await loop.close()
            return values, took_s

    values, took_s = virtual(main())
    assert values == [{"r4": 1004.0}, {"r6": 1006.0}]
    assert took_s < 1.0


def test_an_answer_that_stays_garbled_is_a_link_error(virtual):
    async def main():
        async with Slave(damage=lambda answer: answer[:-1] + b"\x00").serving():
            loop = backend(retries=1)
            await loop.open()
            with pytest.raises(LinkError, match="checksum"):
                await loop.read(["r4"])
            await loop.close()

    virtual(main())


def test_lost_answers_are_asked_for_again(virtual):
    lost = iter([True, False] * 50)

    async def main():
        async with Slave(damage=lambda answer: None if next(lost) else answer).serving():
            return await mixed_reads(50, 5, retries=1)

    assert virtual(main()) == (50, [])


def test_echo_is_stripped_from_reads_and_writes(virtual):
    async def main():
        async with Slave(echo=True).serving() as slave:
            values, wrong = await mixed_reads(100, 3, echo=True)
            loop = backend(echo=True)
            await loop.open()
            await loop.write({"output": 1.0})
            await loop.close()
            return values, wrong, slave.requests[-1]

    values, wrong, written = virtual(main())
    assert (values, wrong) == (100, [])
    assert written[:6] == bytes([UNIT, 6, 0, 50, 0, 1])


def test_a_write_is_not_confirmed_by_its_own_echo(virtual):
    """The answer to function 6 equals the request: with the device dead, only the echo comes back."""

    async def main():
        async with Slave(echo=True, damage=lambda _: None).serving():
            loop = backend(echo=True)
            await loop.open()
            with pytest.raises(DeviceTimeoutError):
                await loop.write({"output": 1.0})
            await loop.close()

    virtual(main())


def test_another_function_or_length_is_not_an_answer(virtual):
    foreign = iter([sealed(bytes([UNIT, 3, 2, 3, 232])), sealed(bytes([UNIT, 4, 4, 3, 232, 3, 233])), None])

    async def main():
        async with Slave(damage=lambda answer: next(foreign) or answer).serving():
            loop = backend(retries=2)
            await loop.open()
            value = await loop.read(["r4"])
            await loop.close()
            return value

    assert virtual(main()) == {"r4": 1004.0}


def test_exception_answers_pass(virtual):
    async def main():
        async with Slave(damage=lambda answer: sealed(bytes([UNIT, answer[1] | 0x80, 2]))).serving():
            loop = backend()
            await loop.open()
            for _ in range(3):
                with pytest.raises(DeviceRefusedError, match="illegal data address"):
                    await loop.read(["r4"])
            took_s = asyncio.get_running_loop().time()
            await loop.close()
            return took_s

    assert virtual(main()) < 0.2


@pytest.mark.parametrize("rate", [0.005, 0.02])
def test_corrupted_bytes_both_ways_give_errors_but_no_wrong_value(virtual, rate):
    random_ = default_rng(7)

    def corrupt(answer: bytes) -> bytes:
        return bytes(b ^ (1 << int(random_.integers(8))) if random_.random() < rate else b for b in answer)

    async def main():
        async with Slave(damage=corrupt).serving():
            return await mixed_reads(1000, 2, retries=2)

    values, wrong = virtual(main())
    assert wrong == []
    assert values > 990


def test_noise_between_answers(virtual):
    random_ = default_rng(9)

    def noisy(answer: bytes) -> bytes:
        return answer + bytes([int(random_.integers(256))]) if random_.random() < 0.2 else answer

    async def main():
        async with Slave(damage=noisy).serving():
            return await mixed_reads(500, 4, retries=2)

    values, wrong = virtual(main())
    assert wrong == []
    assert values > 490


def test_errors_are_typed(virtual):
    async def main():
        loop = backend()
        with pytest.raises(DriverError, match="gateway:4001 unit 7 refused"):
            await loop.open()

    virtual(main())
