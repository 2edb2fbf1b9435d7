"""What crosses between the service and its worker processes."""

import asyncio
import os
import pickle
import signal
from types import MappingProxyType

import pytest

from autotuner import errors
from autotuner.application.computing.compute_pool import NICENESS_OF_VIEWS, Workers
from autotuner.core.recording import Recording

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
        with pytest.raises(errors.ComputationError, match="ended 2 times"):
            await workers.run(os._exit, 1)
        assert await workers.run(abs, -2.0) == 2.0
    finally:
        workers.close()


@pytest.mark.realtime
@pytest.mark.skipif(not hasattr(os, "nice"), reason="processes have no niceness here")
async def test_views_give_way_to_verdicts():
    niceness = []
    for workers in (Workers(), Workers(1, NICENESS_OF_VIEWS)):
        try:
            niceness.append(await workers.run(os.nice, 0))
        finally:
            workers.close()
    assert niceness[1] > niceness[0] > os.nice(0)


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


def killed_once(flag):
    """Kill this process at the first call; tell at the second."""
    if not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "computed"


@pytest.mark.realtime
async def test_a_killed_worker_costs_a_retry_and_not_the_result(tmp_path):
    workers = Workers(2)
    try:
        victim = asyncio.create_task(workers.run(killed_once, tmp_path / "flag"))
        bystanders = [asyncio.create_task(workers.run(abs, -k)) for k in range(4)]
        assert await victim == "computed"
        assert await asyncio.gather(*bystanders) == [0, 1, 2, 3]
    finally:
        workers.close()


@pytest.mark.realtime
async def test_the_end_of_the_workers_ends_what_was_queued_and_given_up():
    """CPython 3.11 fails on the first cancelled future of a broken pool, and the others wait for ever."""
    workers = Workers(2)
    assert await workers.run(abs, -2.0) == 2.0
    queued = [asyncio.create_task(workers.run(signal.pause)) for _ in range(20)]
    await asyncio.sleep(0.1)
    for given_up in queued[1::2]:
        given_up.cancel()
    async with asyncio.timeout(10.0):
        await asyncio.to_thread(workers.close)
        outcomes = await asyncio.gather(*queued, return_exceptions=True)
    assert {type(outcome) for outcome in outcomes[0::2]} == {errors.ShuttingDownError}
    assert {type(outcome) for outcome in outcomes[1::2]} == {asyncio.CancelledError}
