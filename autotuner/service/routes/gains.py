"""Gains in the device: reading them, writing a tuning's, and putting the old ones back."""

from typing import TYPE_CHECKING

from fastapi import APIRouter

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
from autotuner.runtime.gains_desk import gains_of
from autotuner.runtime.sums import gains_for
from autotuner.service import asked, schemas
from autotuner.service.context import FloorOf, ManagerOf, TuningOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.core.tuning import PidGains
    from autotuner.runtime.manager import Manager
    from autotuner.runtime.tuning import Tuning

router = APIRouter(prefix="/v1", tags=["gains"])

AS_TUNED = asked.GainsToApply()
BY_NOISE = asked.VerificationStart()
CAREFULLY = asked.Undo()
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
async def get_device_gains(loop: str, manager: ManagerOf, floor: FloorOf) -> schemas.LoopGains:
    """Read the gains that the device holds now, and what a rollback would undo."""
    return schemas.LoopGains.model_validate(await floor.run(lambda: manager.visit(loop, manager.desk(loop).read)))


@router.post("/tunings/{tuning_id}/apply", responses=WRITING)
async def apply_gains(
    tuning: TuningOf, manager: ManagerOf, floor: FloorOf, body: asked.GainsToApply = AS_TUNED
) -> schemas.Applied:
    """Write the gains to the device and read them back; the old ones are kept, and put back when it refuses any."""
    chosen = gains_of(tuning) if body.is_as_tuned() else await _others(tuning, manager, body)
    desk = manager.desk(tuning.loop)
    applied = await floor.run(lambda: manager.with_loop(tuning, lambda: desk.apply(tuning, chosen)))
    return schemas.Applied.model_validate(applied.to_dict())


@router.post("/tunings/{tuning_id}/verify", responses=WRITING)
async def verify_gains(
    tuning: TuningOf, manager: ManagerOf, floor: FloorOf, body: asked.VerificationStart = BY_NOISE
) -> schemas.VerificationResult:
    """Make a small set-point step under the gains that were applied; they go back unless the loop does as predicted.

    Answered at the end of the step; what is known before is told by the tuning. A step that did not pass is no error.
    """
    desk = manager.desk(tuning.loop)
    run = await floor.run(lambda: manager.with_loop(tuning, lambda: desk.verify(tuning, manager.arithmetic, body.step)))
    return schemas.VerificationResult.model_validate(run.to_dict())


@router.post("/tunings/{tuning_id}/rollback", responses=WRITING)
async def roll_back(
    tuning: TuningOf, manager: ManagerOf, floor: FloorOf, body: asked.Undo = CAREFULLY
) -> schemas.RolledBack:
    """Put the gains back that the device had before this tuning's were applied."""
    desk = manager.desk(tuning.loop)
    back = await floor.run(lambda: manager.with_loop(tuning, lambda: desk.roll_back(tuning, force=body.force)))
    return schemas.RolledBack.model_validate(back.to_dict())


async def _others(tuning: "Tuning", manager: "Manager", body: asked.GainsToApply) -> "PidGains":
    gains_of(tuning)
    assert tuning.analysis is not None  # noqa: S101 - a tuning with gains has one
    known = tuning.analysis
    chosen = await manager.arithmetic.run(gains_for, known.identification, body.wish(), known.sample_time_s)
    return chosen.gains
