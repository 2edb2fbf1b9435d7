"""`/v1/schedules`: gains for several operating points, from one request or from tunings that were made."""

from urllib.parse import quote

from fastapi import APIRouter, Response

from autotuner.application.schedule_run import SchedulePlan, ScheduleRun, combined
from autotuner.application.tuning_run import TuningRequest
from autotuner.errors import (
    InputError,
    LoopBusyError,
    ShuttingDownError,
    StorageError,
    TuningStateError,
    UnknownLoopError,
    UnknownScheduleError,
    UnknownTuningError,
)
from autotuner.service.context import ActorOf, ArchiveOf, ManagerOf
from autotuner.service.problems import accepted, documented
from autotuner.service.schemas import requests, resources

router = APIRouter(prefix="/v1", tags=["gains"])


@router.post(
    "/loops/{loop:path}/schedules",
    status_code=202,
    responses=accepted("run")
    | documented(UnknownLoopError, LoopBusyError, TuningStateError, InputError, ShuttingDownError, StorageError),
)
async def start_schedule(
    loop: str,
    manager: ManagerOf,
    archive: ArchiveOf,
    actor: ActorOf,
    response: Response,
    body: requests.ScheduleStart,
) -> resources.ScheduleRun:
    """Tune at several set points, one after the other: the device's own controller takes the loop from one to the next.

    The set point goes back in the end, whatever happens.
    """
    overrides = {} if body.check is None else {"check": body.check}
    settings = manager.configuration.loop(loop).experiment_settings(**overrides)
    request = TuningRequest(settings, body.structure, body.spec(), actor)
    plan = SchedulePlan(tuple(body.set_points), request, body.variable, body.hysteresis)
    await archive.room()
    run = manager.schedules.start(loop, plan)
    response.headers["Location"] = f"{router.prefix}/schedules/{quote(run.id, safe='')}"
    return _resource(run)


@router.post("/schedules", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def combine_tunings(manager: ManagerOf, body: requests.TuningsToCombine) -> resources.Schedule:
    """Make a schedule of the gains of tunings that were made at several operating points; nothing is written."""
    tunings = [manager.tuning(tuning_id) for tuning_id in body.tuning_ids]
    return resources.Schedule.model_validate(combined(tunings, body.variable, body.hysteresis).to_dict())


@router.get("/schedules/{schedule_id}", responses=documented(UnknownScheduleError))
async def get_schedule(schedule_id: str, manager: ManagerOf) -> resources.ScheduleRun:
    """Return a run over operating points, and its gain schedule."""
    return _resource(manager.schedules.run(schedule_id))


@router.post("/schedules/{schedule_id}/abort", status_code=202, responses=documented(UnknownScheduleError))
async def abort_schedule(schedule_id: str, manager: ManagerOf) -> resources.ScheduleRun:
    """End a run: its tuning gives the output back, then the set point goes back."""
    return _resource(manager.schedules.abort(schedule_id))


def _resource(run: ScheduleRun) -> resources.ScheduleRun:
    return resources.ScheduleRun.model_validate(run.to_dict())
