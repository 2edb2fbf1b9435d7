"""The Modbus driver against a device that misbehaves as scripted; all in virtual time."""

import asyncio
import itertools
import logging
import math
from logging.handlers import BufferingHandler

import pytest
from pymodbus.exceptions import ModbusIOException

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, InputError, LinkError
from autotuner.ports import Backend
from autotuner_drivers.modbus.backend import create
from autotuner_drivers.modbus.lines import TcpLine

PV_AND_OUTPUT = {
    "pv": {"table": "input", "address": 0, "scale": 0.1},
    "output": {"table": "holding", "address": 0, "scale": 0.1},
}


def backend(**options):
    return create(
        {"host": "device", "port": 1502, "timeout_s": 0.5, "retries": 0, "registers": PV_AND_OUTPUT} | options
    )


def answer(frame: bytes, pdu: bytes) -> bytes:
    return frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu


def registers(frame: bytes, *words: int) -> bytes:
    """Return the answer of a read of registers."""
    return answer(frame, frame[7:8] + bytes([2 * len(words)]) + b"".join(w.to_bytes(2, "big") for w in words))


async def healthy(device, frame, writer):
    """Registers hold their own address plus 200; writes are confirmed."""
    function, address, count = frame[7], int.from_bytes(frame[8:10], "big"), int.from_bytes(frame[10:12], "big")
    if function in {3, 4}:
        writer.write(registers(frame, *range(200 + address, 200 + address + count)))
    else:
        writer.write(answer(frame, frame[7:12]))


def test_it_is_a_backend():
    assert isinstance(backend(), Backend)
    assert backend().readable == {"pv", "output"}
    assert backend().writable == {"output"}


def test_it_tells_what_its_registers_hold():
    assert backend().limits("output") == pytest.approx((-3276.8, 3276.7))
    assert backend().resolution("output", 12.3) == 0.1


def test_read_and_write(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving() as device:
            loop = backend()
            await loop.open()
            assert await loop.read(["output", "pv"]) == {"pv": 20.0, "output": 20.0}
            await loop.write({"output": -12.3})
            await loop.close()
            return device.requests

    _, _, written = virtual(main())
    # function 6, register 0, -123 as two's complement
    assert written[6:] == bytes([1, 6, 0, 0, 0xFF, 0x85])


def test_a_device_without_function_6_gets_function_16(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving() as device:
            loop = backend(use_fc6=False, unit=7)
            await loop.open()
            await loop.write({"output": 1.0})
            await loop.close()
            return device.requests[0]

    assert virtual(main())[6:] == bytes([7, 16, 0, 0, 0, 1, 2, 0, 10])


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        (1, DeviceRefusedError, "illegal function"),
        (2, DeviceRefusedError, "illegal data address"),
        (3, DeviceRefusedError, "illegal data value"),
        (4, DeviceRefusedError, "device failure"),
        (6, DeviceRefusedError, "busy"),
        (10, LinkError, "gateway path"),
        (11, DeviceTimeoutError, "behind the gateway"),
        (77, DeviceRefusedError, "not in the standard"),
    ],
)
def test_exception_codes(virtual, scripted_device, code, kind, words):
    async def refuse(device, frame, writer):
        writer.write(answer(frame, bytes([frame[7] | 0x80, code])))

    async def main():
        async with scripted_device(refuse).serving():
            loop = backend()
            await loop.open()
            with pytest.raises(kind, match=words) as refusal:
                await loop.read(["pv"])
            await loop.close()
            return refusal.value

    error = virtual(main())
    assert "device:1502 unit 1" in str(error)
    assert error.remedy


def test_a_silent_device_is_given_up_at_the_time_limit_and_each_repetition(virtual, scripted_device):
    async def silent(device, frame, writer):
        pass

    async def main():
        async with scripted_device(silent).serving() as device:
            loop = backend(retries=2)
            await loop.open()
            start = asyncio.get_running_loop().time()
            with pytest.raises(DeviceTimeoutError, match=r"did not answer within 0\.5 s") as refusal:
                await loop.read(["pv"])
            took_s = asyncio.get_running_loop().time() - start
            await loop.close()
            return took_s, len(device.requests), refusal.value

    took_s, requests, error = virtual(main())
    assert took_s == pytest.approx(1.5, abs=0.01)
    assert requests == 3
    assert isinstance(error.__cause__, ModbusIOException)


def test_an_answer_that_comes_late_is_never_taken_for_the_next_one(virtual, scripted_device):
    """The first answer, 999, arrives while the second request is under way."""
    late = []

    async def script(device, frame, writer):
        if len(device.requests) == 1:
            late.append(registers(frame, 999))
            return
        writer.write(late[0])
        await asyncio.sleep(0.1)
        writer.write(registers(frame, 215))

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            with pytest.raises(DeviceTimeoutError):
                await loop.read(["pv"])
            value = await loop.read(["pv"])
            await loop.close()
            return value

    assert virtual(main()) == {"pv": 21.5}


def test_a_connection_closed_mid_request_is_told_at_once_and_made_again(virtual, scripted_device):
    async def script(device, frame, writer):
        if device.connections == 1:
            writer.close()
        else:
            await healthy(device, frame, writer)

    async def main():
        async with scripted_device(script).serving() as device:
            loop = backend(timeout_s=30.0)
            await loop.open()
            start = asyncio.get_running_loop().time()
            with pytest.raises(LinkError, match="closed the connection") as refusal:
                await loop.read(["pv"])
            took_s = asyncio.get_running_loop().time() - start
            value = await loop.read(["pv"])
            await loop.close()
            return took_s, refusal.value, value, device.connections

    took_s, error, value, connections = virtual(main())
    assert took_s < 1.0
    assert isinstance(error.__cause__, ConnectionResetError)
    assert value == {"pv": 20.0}
    assert connections == 2


def test_a_refused_connection_and_its_pause(virtual, scripted_device):
    async def main():
        clock = asyncio.get_running_loop().time
        loop = backend()
        with pytest.raises(LinkError, match="refused the connection") as refusal:
            await loop.open()
        assert isinstance(refusal.value.__cause__, ConnectionRefusedError)
        with pytest.raises(LinkError, match=r"refused the connection; the next attempt is due in 0\.\d s\. Check"):
            await loop.read(["pv"])
        attempts = []
        for _ in range(1000):
            await asyncio.sleep(0.01)
            with pytest.raises(LinkError) as refusal:
                await loop.read(["pv"])
            if "next attempt" not in str(refusal.value):
                attempts.append(clock())
        async with scripted_device(healthy).serving():
            await asyncio.sleep(2.0)
            assert await loop.read(["pv"]) == {"pv": 20.0}
            await loop.close()
        return attempts

    attempts = virtual(main())
    pauses = [b - a for a, b in itertools.pairwise(attempts)]
    assert pauses[:4] == pytest.approx([0.2, 0.4, 0.8, 1.6], abs=0.02)
    assert pauses[4:] == pytest.approx([2.0] * len(pauses[4:]), abs=0.02)


def test_opening_by_hand_does_not_wait_for_the_pause(virtual, scripted_device):
    async def main():
        loop = backend()
        for _ in range(5):
            with pytest.raises(LinkError):
                await loop.open()
        async with scripted_device(healthy).serving():
            await loop.open()
            await loop.open()
            value = await loop.read(["pv"])
            await loop.close()
            return value

    assert virtual(main()) == {"pv": 20.0}


def test_the_time_of_an_answer_is_known(virtual, scripted_device):
    delays = iter([0.1, 0.3, 0.2, 0.2, 0.4])

    async def slow(device, frame, writer):
        await asyncio.sleep(next(delays))
        writer.write(registers(frame, 1))

    async def main():
        async with scripted_device(slow).serving():
            loop = backend()
            at_first = loop.latency_s
            await loop.open()
            for _ in range(5):
                await loop.read(["pv"])
            await loop.close()
            return at_first, loop.latency_s

    assert virtual(main()) == (0.0, pytest.approx(0.2, abs=1e-3))


def test_a_cancelled_read_leaves_the_link_usable(virtual, scripted_device):
    async def slow(device, frame, writer):
        await asyncio.sleep(0.2)
        writer.write(registers(frame, len(device.requests)))

    async def main():
        async with scripted_device(slow).serving() as device:
            loop = backend()
            await loop.open()
            for expected in range(2, 21, 2):
                under_way = asyncio.create_task(loop.read(["pv"]))
                await asyncio.sleep(0.1)
                under_way.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await under_way
                assert await loop.read(["pv"]) == {"pv": pytest.approx(0.1 * expected)}
            await loop.close()
            return device.connections

    assert virtual(main()) == 1


def test_closing_ends_a_read_under_way_and_is_idempotent(virtual, scripted_device):
    async def silent(device, frame, writer):
        pass

    async def main():
        async with scripted_device(silent).serving():
            loop = backend(timeout_s=30.0)
            await loop.open()
            under_way = asyncio.create_task(loop.read(["pv"]))
            await asyncio.sleep(0.1)
            await loop.close()
            await loop.close()
            with pytest.raises(LinkError):
                await under_way
            with pytest.raises(LinkError, match="not open"):
                await loop.read(["pv"])
            return asyncio.get_running_loop().time()

    assert virtual(main()) < 1.0


def test_it_opens_again_after_closing(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving():
            loop = backend()
            for _ in range(3):
                await loop.open()
                assert await loop.read(["pv"]) == {"pv": 20.0}
                await loop.close()

    virtual(main())


def test_calls_from_several_tasks_do_not_mix(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving():
            loop = create(
                {
                    "host": "device",
                    "port": 1502,
                    "registers": PV_AND_OUTPUT | {"more": {"table": "input", "address": 50, "scale": 0.1}},
                }
            )
            await loop.open()
            both = await asyncio.gather(*[loop.read([name]) for name in ("pv", "more") * 20])
            await loop.close()
            return both

    assert virtual(main()) == [{"pv": 20.0}, {"more": 25.0}] * 20


@pytest.mark.parametrize("cut", [1, 3, 5])
def test_answers_in_pieces(virtual, scripted_device, cut):
    async def script(device, frame, writer):
        whole = registers(frame, 215)
        for i in range(0, len(whole), cut):
            writer.write(whole[i : i + cut])
            await asyncio.sleep(0.01)

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            values = [await loop.read(["pv"]) for _ in range(3)]
            await loop.close()
            return values

    assert virtual(main()) == [{"pv": 21.5}] * 3


def test_answers_that_come_twice(virtual, scripted_device):
    async def script(device, frame, writer):
        writer.write(2 * registers(frame, 100 * len(device.requests)))

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            values = [(await loop.read(["pv"]))["pv"] for _ in range(3)]
            await loop.close()
            return values

    assert virtual(main()) == [10.0, 20.0, 30.0]


def test_an_answer_of_the_wrong_length_is_an_error(virtual, scripted_device):
    async def script(device, frame, writer):
        writer.write(registers(frame, 1, 2, 3))

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            with pytest.raises(LinkError, match="3 values where 1"):
                await loop.read(["pv"])
            await loop.close()

    virtual(main())


def test_a_write_confirmed_for_another_register_is_an_error(virtual, scripted_device):
    async def script(device, frame, writer):
        writer.write(answer(frame, bytes([6, 0, 9]) + frame[10:12]))

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            with pytest.raises(LinkError, match="confirmed address 9"):
                await loop.write({"output": 1.0})
            await loop.close()

    virtual(main())


@pytest.mark.parametrize("garbage", [b"\xff" * 20, b"\x00" * 20, b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_garbage_ends_in_a_typed_error_and_the_link_recovers(virtual, scripted_device, garbage):
    async def script(device, frame, writer):
        if len(device.requests) < 3:
            writer.write(garbage)
        else:
            await healthy(device, frame, writer)

    async def main():
        async with scripted_device(script).serving():
            loop = backend()
            await loop.open()
            for _ in range(2):
                with pytest.raises(LinkError):
                    await loop.read(["pv"])
            await asyncio.sleep(3.0)
            value = await loop.read(["pv"])
            await loop.close()
            return value

    assert virtual(main()) == {"pv": 20.0}


def test_a_dead_peer_behind_an_open_connection_is_dropped_after_three_silent_requests(virtual, scripted_device):
    async def script(device, frame, writer):
        if device.connections > 1:
            await healthy(device, frame, writer)

    async def main():
        async with scripted_device(script).serving() as device:
            loop = backend()
            await loop.open()
            for _ in range(3):
                with pytest.raises(DeviceTimeoutError):
                    await loop.read(["pv"])
            value = await loop.read(["pv"])
            await loop.close()
            return value, device.connections

    assert virtual(main()) == ({"pv": 20.0}, 2)


def test_a_broken_sensor_is_nan_and_not_a_number(virtual, scripted_device):
    async def broken(device, frame, writer):
        writer.write(registers(frame, 0x7FC0, 0x0000))

    async def main():
        async with scripted_device(broken).serving():
            pv = {"table": "input", "address": 0, "type": "float32"}
            loop = backend(registers=PV_AND_OUTPUT | {"pv": pv})
            await loop.open()
            value = await loop.read(["pv"])
            await loop.close()
            return value["pv"]

    assert math.isnan(virtual(main()))


def test_a_value_that_does_not_fit_stops_the_whole_write_before_anything_is_sent(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving() as device:
            loop = backend(registers=PV_AND_OUTPUT | {"kp": {"table": "holding", "address": 1}})
            await loop.open()
            with pytest.raises(DeviceRefusedError, match="does not fit int16 at holding 0"):
                await loop.write({"kp": 1.0, "output": 4000.0})
            await loop.close()
            return device.requests

    assert virtual(main()) == []


def test_unknown_and_read_only_signals_are_refused(virtual):
    async def main():
        with pytest.raises(InputError, match="can read"):
            await backend().read(["temperature"])
        with pytest.raises(InputError, match="can write"):
            await backend().write({"pv": 1.0})

    virtual(main())


def test_a_connection_lost_while_it_is_made_is_made_again(virtual, scripted_device, monkeypatch):
    """The library takes such a connection for one that is there, for ever; the output would never be given back."""
    made = []
    client = TcpLine.client

    def stumbling(line, timeout_s, hooks):
        one = client(line, timeout_s, hooks)
        create = one.ctx.call_create

        async def reset_at_once():
            transport, protocol = await create()
            made.append(transport)
            if len(made) == 2:
                transport.abort()
                await asyncio.sleep(0.01)
            return transport, protocol

        one.ctx.call_create = reset_at_once
        return one

    monkeypatch.setattr(TcpLine, "client", stumbling)

    async def main():
        async with scripted_device(healthy).serving():
            loop = backend()
            await loop.open()
            made[0].abort()
            await asyncio.sleep(0.05)
            with pytest.raises(LinkError):
                await loop.read(["pv"])
            await asyncio.sleep(0.2)
            seen = await loop.read(["pv"])
            await loop.close()
            return seen

    assert virtual(main()) == {"pv": 20.0}


def test_a_connection_that_the_device_closes_is_made_again_at_once(virtual, scripted_device):
    async def main():
        async with scripted_device(healthy).serving() as device:
            loop = backend()
            await loop.open()
            await loop.read(["pv"])
            device.hang_up()
            await asyncio.sleep(0.01)
            connections = device.connections
            await loop.close()
            return connections

    assert virtual(main()) == 2


def test_a_device_that_accepts_and_closes_is_not_stormed(virtual, scripted_device):
    async def slam(device, frame, writer):
        writer.close()

    async def main():
        async with scripted_device(slam).serving() as device:
            loop = backend()
            await loop.open()
            for _ in range(50):
                with pytest.raises(LinkError):
                    await loop.read(["pv"])
                await asyncio.sleep(0.1)
            await loop.close()
            return device.connections

    assert virtual(main()) < 12


def test_a_device_that_is_gone_is_told_between_two_calls(virtual, scripted_device):
    """It closes the connection and listens no more; one that still listens is not gone."""

    async def main():
        told = []
        loop = backend()
        loop.watch(lambda reason: told.append((asyncio.get_running_loop().time(), reason)))
        async with scripted_device(healthy).serving() as device:
            await loop.open()
            await loop.read(["pv"])
            device.hang_up()
            await asyncio.sleep(0.01)
            await loop.read(["pv"])
            assert not told
            left_s = asyncio.get_running_loop().time()
        await asyncio.sleep(1.0)
        await loop.close()
        return left_s, told

    left_s, told = virtual(main())
    assert len(told) == 1
    assert told[0][0] - left_s < 0.005
    assert "device" in told[0][1]


@pytest.fixture
def log_of_the_service():
    """What comes to the root of all logs, where the service writes."""
    taker, root = BufferingHandler(1000), logging.getLogger()
    root.addHandler(taker)
    yield taker.buffer
    root.removeHandler(taker)


@pytest.mark.parametrize("damaged", [bytes([9, 2, 0, 200]), bytes([4, 0x42, 0, 200])], ids=["function", "size"])
def test_an_answer_that_nobody_can_read_is_asked_for_again(virtual, scripted_device, log_of_the_service, damaged):
    """Over the same connection: it was not the device that closed one. The log of the service is not told its bytes."""

    async def once_damaged(device, frame, writer):
        if len(device.requests) == 2:
            writer.write(answer(frame, damaged))
        else:
            await healthy(device, frame, writer)

    async def main():
        async with scripted_device(once_damaged).serving() as device:
            loop = backend(retries=1)
            await loop.open()
            seen = [await loop.read(["pv"]) for _ in range(3)]
            await loop.close()
            return seen, device.connections, len(device.requests)

    assert virtual(main()) == ([{"pv": 20.0}] * 3, 1, 4)
    assert [record.getMessage() for record in log_of_the_service] == []


def test_without_repetitions_it_is_told_for_what_it_is(virtual, scripted_device):
    async def damaged(_device, frame, writer):
        writer.write(answer(frame, bytes([9, 2, 0, 200])))

    async def main():
        async with scripted_device(damaged).serving():
            loop = backend()
            await loop.open()
            with pytest.raises(LinkError, match="sent an answer that cannot be decoded"):
                await loop.read(["pv"])
            await loop.close()

    virtual(main())
