"""The floor: what others have done where the loops run, and what happens when it ends or breaks down."""

import asyncio
import sys
import threading
from contextlib import asynccontextmanager

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.floor import Here, OwnThread
from autotuner.application.manager import Manager
from autotuner.application.tuning_run import TuningRequest
from autotuner.configuration import parse_configuration
from autotuner.control.reporting.events import SampleTaken
from autotuner.errors import InputError, ShuttingDownError
from tests.control.processes import PATIENCE_S

FAST = {
    "driver": "simulated",
    "sample_time_s": 0.02,
    "limits": {"output": [0.0, 100.0]},
    "relay": {"amplitude": 10.0, "quiet_s": 0.5, "min_periods": 500, "max_periods": 1000},
    "device": {"plant": {"structure": "fopdt", "K": 2.0, "T": 0.5, "D": 0.2}, "output0": 40.0, "pv0": 80.0},
}


async def no_rescue():
    """There is nothing to give back."""


@asynccontextmanager
async def opened(floor, rescue=no_rescue):
    floor.open(rescue)
    try:
        yield floor
    finally:
        await floor.close()


async def broken_down(floor):
    """Break a thread down as a driver that ends the program would, and wait for its end."""
    floor._loop.call_soon_threadsafe(sys.exit, 3)
    await asyncio.to_thread(floor._thread.join, PATIENCE_S)
    assert not floor._thread.is_alive()


@pytest.fixture(params=[Here, OwnThread])
def floor(request):
    return request.param()


async def test_what_is_done_there_is_returned(floor):
    async def thread():
        await asyncio.sleep(0.0)
        return threading.current_thread()

    async with opened(floor):
        at = await floor.do(threading.current_thread)
        assert await floor.run(thread) is at
    assert (at is threading.current_thread()) == isinstance(floor, Here)


async def test_errors_arrive_with_their_type(floor):
    def refuse():
        raise InputError("must be positive", remedy="Give a positive number.", field="amplitude", value=-1.0)

    async def refuse_later():
        await asyncio.sleep(0.0)
        refuse()

    async with opened(floor):
        with pytest.raises(InputError) as at_once:
            await floor.do(refuse)
        with pytest.raises(InputError) as later:
            await floor.run(refuse_later)
    assert vars(at_once.value) == vars(later.value)
    assert (at_once.value.field, at_once.value.value) == ("amplitude", -1.0)


async def test_a_caller_that_gives_up_ends_what_it_asked_for(floor):
    begun, ended = asyncio.Event(), threading.Event()
    here = asyncio.get_running_loop()

    async def work():
        here.call_soon_threadsafe(begun.set)
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            ended.set()
            raise

    async with opened(floor):
        caller = asyncio.create_task(floor.run(work))
        await begun.wait()
        caller.cancel()
        with pytest.raises(asyncio.CancelledError):
            await caller
        assert await asyncio.to_thread(ended.wait, PATIENCE_S)


async def test_a_floor_that_is_not_open_is_told():
    floor = OwnThread()
    for _ in range(2):
        with pytest.raises(ShuttingDownError):
            await floor.do(threading.current_thread)
        await floor.close()
    async with opened(OwnThread()) as floor:
        pass
    with pytest.raises(ShuttingDownError):
        await floor.do(threading.current_thread)
    await floor.close()
    assert floor.fault is None


async def test_work_under_way_is_cancelled_at_the_end_and_its_caller_told():
    cancelled = threading.Event()

    async def work():
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    async with opened(OwnThread()) as floor:
        caller = asyncio.create_task(floor.run(work))
        await floor.do(threading.current_thread)
    with pytest.raises(ShuttingDownError):
        await caller
    assert cancelled.is_set()


async def test_nobody_waits_for_a_floor_that_is_gone():
    """Whoever asks in the very moment of its end is answered, or told."""
    for _ in range(20):
        floor = OwnThread()
        floor.open(no_rescue)
        asked = [asyncio.create_task(floor.do(lambda: 1)) for _ in range(10)]
        ending = asyncio.create_task(floor.close())
        while not ending.done():
            asked.append(asyncio.create_task(floor.do(lambda: 1)))
            await asyncio.sleep(0.0)
        answers = await asyncio.wait_for(asyncio.gather(*asked, return_exceptions=True), PATIENCE_S)
        assert all(answer == 1 or isinstance(answer, ShuttingDownError) for answer in answers)


@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt])
async def test_a_fault_gives_the_loops_back_and_spares_the_caller(kind, caplog):
    rescued = []

    async def rescue():
        await asyncio.sleep(0.0)
        rescued.append(threading.current_thread().name)

    async def end_the_program():
        raise kind

    async with opened(OwnThread(), rescue) as floor:
        with pytest.raises(ShuttingDownError) as told:
            await floor.run(end_the_program)
        floor.end()
        assert rescued == ["loops"]
        assert isinstance(floor.fault, kind)
        with pytest.raises(ShuttingDownError):
            await floor.do(threading.current_thread)
    assert isinstance(told.value.__cause__, kind)
    assert "broke down" in caplog.text


async def test_a_rescue_that_fails_ends_the_thread_all_the_same(monkeypatch):
    said = []
    monkeypatch.setattr(threading, "excepthook", said.append)

    async def rescue():
        raise OSError("the selector is gone")

    async with opened(OwnThread(), rescue) as floor:
        await broken_down(floor)
    assert isinstance(floor.fault, SystemExit)
    assert [hook.exc_type for hook in said] == [OSError]


@pytest.fixture
def manager(tmp_path):
    """The manager of two loops, started on a floor by the function that is returned with it."""
    values = {"service": {"data_directory": str(tmp_path)}, "loops": {"one": FAST, "two": FAST}}
    return Manager(parse_configuration(values, "test"), InPlace())


async def started(floor, manager):
    """Start tunings of both loops, and return them once their outputs stand elsewhere."""
    settings = manager.configuration.loop("one").experiment_settings()
    tunings = [
        await floor.do(lambda loop=loop: manager.start(loop, TuningRequest(settings))) for loop in ("one", "two")
    ]
    for tuning in tunings:
        async for event in tuning.follow():
            if isinstance(event, SampleTaken) and event.output > 45.0:
                break
    return tunings


async def outputs(manager):
    """What the devices hold, asked past everything."""
    return [
        (await backend.read(["output"]))["output"] for backend in manager._backends.values() if await opens(backend)
    ]


async def opens(backend):
    await backend.open()
    return True


@pytest.mark.realtime
async def test_loops_are_given_back_when_their_thread_breaks_down(manager):
    async with opened(OwnThread(), manager.close) as floor:
        tunings = await started(floor, manager)
        await broken_down(floor)
    assert [tuning.verdict.code for tuning in tunings] == ["shutdown", "shutdown"]
    assert [tuning.controller.restored for tuning in tunings] == [True, True]
    assert await outputs(manager) == [40.0, 40.0]


@pytest.mark.realtime
async def test_loops_are_given_back_when_the_floor_ends_and_nobody_closed_the_manager(manager):
    async with opened(OwnThread(), manager.close) as floor:
        tunings = await started(floor, manager)
    assert [tuning.verdict.code for tuning in tunings] == ["cancelled", "cancelled"]
    assert await outputs(manager) == [40.0, 40.0]


@pytest.mark.realtime
async def test_every_reader_sees_all_events_in_order_from_another_thread(manager):
    async with opened(OwnThread(), manager.close) as floor:
        tuning, other = await started(floor, manager)

        async def read():
            return [event async for event in tuning.follow()]

        readers = [asyncio.create_task(read()) for _ in range(3)]
        async for event in tuning.follow():
            if isinstance(event, SampleTaken) and len(tuning.samples) >= 100:
                break
        await floor.run(manager.close)
        seen = await asyncio.wait_for(asyncio.gather(*readers), PATIENCE_S)
    assert seen == [tuning.events] * 3
    assert other.told_all
