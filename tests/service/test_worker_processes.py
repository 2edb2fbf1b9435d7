"""What crosses between the service and its worker processes."""

import asyncio
import os
import pickle
import signal
from concurrent.futures.process import BrokenProcessPool
from types import MappingProxyType

import pytest

from autotuner import errors
from autotuner.core.recording import Recording
from autotuner.runtime.arithmetic import Workers

ERRORS = [
    errors.InputError("must be positive", remedy="Give a positive number.", field="amplitude", value=-1.0),
    errors.RecordingError("is empty", remedy="Record for longer."),
    errors.LoopBusyError("TIC-101", "a1b2"),
    errors.ShuttingDownError(),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_crosses_unharmed(error):
    arrived = pickle.loads(pickle.dumps(error))  # noqa: S301 - what was just made here
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived) == vars(error)


def refuse():
    raise ERRORS[0]


@pytest.mark.realtime
async def test_an_error_in_a_worker_is_raised_here_and_a_dead_worker_is_replaced():
    workers = Workers()
    try:
        with pytest.raises(errors.InputError, match="amplitude: must be positive"):
            await workers.run(refuse)
        with pytest.raises(BrokenProcessPool):
            await workers.run(os._exit, 1)
        assert await workers.run(abs, -2.0) == 2.0
    finally:
        workers.close()


@pytest.mark.realtime
async def test_a_recording_goes_to_a_worker_and_back():
    workers = Workers()
    sent = Recording([0.0, 1.0], [40.0, 50.0], [80.0, 80.5], settings=MappingProxyType({"relay_high": 50.0}))
    try:
        arrived = await workers.run(Recording.window, sent, 0.0, 1.0)
    finally:
        workers.close()
    assert arrived.to_csv() == sent.to_csv()
    assert dict(arrived.settings) == {"relay_high": 50.0}


@pytest.mark.realtime
async def test_work_that_waits_is_dropped_when_the_workers_go():
    workers = Workers()
    asked = [asyncio.create_task(workers.run(abs, -2.0)) for _ in range(8)]
    await asyncio.sleep(0.0)
    workers.close()
    outcomes = await asyncio.gather(*asked, return_exceptions=True)
    assert all(outcome == 2.0 or isinstance(outcome, errors.ShuttingDownError) for outcome in outcomes)
    assert isinstance(outcomes[-1], errors.ShuttingDownError)
    with pytest.raises(errors.ShuttingDownError):
        await workers.run(abs, -2.0)


@pytest.mark.realtime
async def test_a_worker_that_never_ends_is_ended_with_its_owner():
    workers = Workers()
    assert await workers.run(abs, -2.0) == 2.0  # it runs
    endless = asyncio.create_task(workers.run(signal.pause))
    behind = asyncio.create_task(workers.run(abs, -2.0))
    await asyncio.sleep(0.0)
    workers.interrupt()
    for asked in (endless, behind):
        with pytest.raises(errors.ShuttingDownError):
            await asked
    workers.close()
