"""`/v1/loops/{loop}/monitor`: comparison of a loop with its expected behaviour. Nothing is written."""

from typing import Annotated

from fastapi import APIRouter, Depends

from autotuner.application.manager import Manager
from autotuner.application.monitor import Monitor, plan_of
from autotuner.errors import InputError, ShuttingDownError, TuningStateError, UnknownLoopError, UnknownTuningError
from autotuner.service.archive.archive import Archive
from autotuner.service.context import ArchiveOf, ManagerOf, Seen, kept, tuning_seen
from autotuner.service.operations.watch_list import Watched, WatchList
from autotuner.service.problems import documented
from autotuner.service.schemas import requests
from autotuner.service.schemas.monitoring import Monitoring

WatchListOf = Annotated[WatchList, Depends(kept("watch_list"))]

router = APIRouter(prefix="/v1/loops", tags=["loops"])
BY_THE_LAST = requests.MonitorStart()


@router.post(
    "/{loop:path}/monitor",
    responses=documented(UnknownLoopError, UnknownTuningError, TuningStateError, InputError, ShuttingDownError),
)
async def start_monitor(
    loop: str,
    manager: ManagerOf,
    archive: ArchiveOf,
    watch_list: WatchListOf,
    body: requests.MonitorStart = BY_THE_LAST,
) -> Monitoring:
    """Monitor a loop in normal operation: reads only, compared periodically with the prediction of its tuning."""
    tuning = await _tuning(loop, manager, archive, body.tuning_id)
    plan = plan_of(tuning.to_dict(), manager.configuration.loop(loop).sample_time_s, body.window_s)
    monitor = manager.monitors.start(plan)
    watch_list.note(loop, Watched(tuning_id=plan.tuning_id, window_s=plan.window_s))
    return _resource(loop, monitor)


@router.get("/{loop:path}/monitor", responses=documented(UnknownLoopError))
async def get_monitor(loop: str, manager: ManagerOf) -> Monitoring:
    """Return the result of monitoring a loop."""
    return _resource(loop, manager.monitors.of(loop))


@router.delete("/{loop:path}/monitor", responses=documented(UnknownLoopError))
async def end_monitor(loop: str, manager: ManagerOf, watch_list: WatchListOf) -> Monitoring:
    """Watch a loop no more."""
    manager.monitors.end(loop)
    watch_list.note(loop, None)
    return _resource(loop, None)


async def _tuning(loop: str, manager: Manager, archive: Archive, tuning_id: str | None) -> Seen:
    """Return the tuning whose model gives the expected behaviour of a loop: one of its own."""
    manager.configuration.loop(loop)
    if tuning_id is None:
        own = (tuning for tuning in manager.newest_first() if tuning.loop == loop and tuning.model is not None)
        if (last := next(own, None)) is not None:
            return last
        raise TuningStateError(
            "has no tuning of this run of the service with a model",
            field="loop",
            value=loop,
            remedy="Name one of an earlier run by tuning_id, or tune the loop.",
        )
    found = await tuning_seen(tuning_id, manager, archive)
    if found.loop != loop:
        raise InputError(
            "is a tuning of another loop", field="tuning_id", value=tuning_id, remedy=f"Name one of {loop}."
        )
    return found


def _resource(loop: str, monitor: Monitor | None) -> Monitoring:
    return Monitoring.model_validate(monitor.to_dict() if monitor else {"loop": loop, "state": "off"})
