"""Gains in the device: reading them, writing a tuning's, and putting the old ones back."""

import asyncio
from typing import TYPE_CHECKING

from fastapi import APIRouter

from autotuner.application.computing.computations import gains_for
from autotuner.application.tuning_run import gains_of
from autotuner.errors import (
    DriverError,
    GainsChangedError,
    InputError,
    LoopBusyError,
    ShuttingDownError,
    StorageError,
    TuningStateError,
    UnknownLoopError,
    UnknownTuningError,
)
from autotuner.service.context import ActorOf, ComputationsOf, ManagerOf, TuningOf
from autotuner.service.problems import documented
from autotuner.service.schemas import requests, resources

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from autotuner.application.tuning_run import TuningRun
    from autotuner.control.verification.verification_run import VerificationRun
    from autotuner.core.design import PidGains
    from autotuner.service.operations.compute_queue import ClientComputations

router = APIRouter(prefix="/v1", tags=["gains"])

AS_TUNED = requests.GainsToApply()
BY_NOISE = requests.VerificationStart()
CAREFULLY = requests.Undo()
WRITING = documented(
    UnknownTuningError,
    TuningStateError,
    LoopBusyError,
    GainsChangedError,
    InputError,
    DriverError,
    ShuttingDownError,
    StorageError,
)


@router.get("/loops/{loop:path}/gains", responses=documented(UnknownLoopError, LoopBusyError, InputError, DriverError))
async def get_device_gains(loop: str, manager: ManagerOf) -> resources.LoopGains:
    """Read the gains in the device, and the gains that a rollback would restore."""
    try:
        return resources.LoopGains.model_validate(await manager.visit(loop, manager.gain_service(loop).read))
    except asyncio.CancelledError:
        if (caller := asyncio.current_task()) is not None and caller.cancelling():
            raise
        raise ShuttingDownError from None  # or the configuration is read again


@router.post("/tunings/{tuning_id}/apply", responses=WRITING)
async def apply_gains(
    tuning: TuningOf,
    manager: ManagerOf,
    computations: ComputationsOf,
    body: requests.GainsToApply = AS_TUNED,
) -> resources.Applied:
    """Write the gains to the device and read them back; the old ones are stored, and restored when it refuses any."""
    chosen = gains_of(tuning) if body.is_as_tuned() else await _others(tuning, computations, body)
    applied = await manager.with_loop(tuning, lambda: manager.apply(tuning, chosen))
    return resources.Applied.model_validate(applied.to_dict())


@router.post("/tunings/{tuning_id}/verify", responses=WRITING)
async def verify_gains(
    tuning: TuningOf, manager: ManagerOf, actor: ActorOf, body: requests.VerificationStart = BY_NOISE
) -> resources.VerificationResult:
    """Make a small set-point step under the gains that were applied; they go back unless the loop does as predicted.

    Answered at the end of the step; `GET verification/events` follows it. A step that did not pass is not an error.
    """
    gain_service = manager.gain_service(tuning.loop)

    def work() -> "Coroutine[object, object, VerificationRun]":
        return gain_service.verify(tuning, manager.pool, body.step, actor)

    run = await manager.with_loop(tuning, work)
    return resources.VerificationResult.model_validate(run.to_dict())


@router.post("/tunings/{tuning_id}/rollback", responses=WRITING)
async def roll_back(tuning: TuningOf, manager: ManagerOf, body: requests.Undo = CAREFULLY) -> resources.RolledBack:
    """Put the gains back that the device had before this tuning's were applied."""
    gain_service = manager.gain_service(tuning.loop)
    back = await manager.with_loop(tuning, lambda: gain_service.roll_back(tuning, force=body.force))
    return resources.RolledBack.model_validate(back.to_dict())


async def _others(tuning: "TuningRun", computations: "ClientComputations", body: requests.GainsToApply) -> "PidGains":
    gains_of(tuning)
    assert tuning.analysis is not None  # noqa: S101 - a tuning with gains has one
    known = tuning.analysis
    chosen = await computations.run(
        gains_for,
        known.identification,
        body.spec(),
        known.sample_time_s,
        known.context.device,
        output_span=known.context.output_span,
    )
    return chosen.gains
