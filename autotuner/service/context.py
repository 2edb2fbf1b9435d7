"""What the endpoints stand on: the manager, the floor where its loops run, and the tuning that a path names."""

from asyncio import Lock
from typing import Annotated, cast

from fastapi import Depends, Request

from autotuner.errors import TuningStateError
from autotuner.runtime.analysis import Analysis
from autotuner.runtime.floor import Floor
from autotuner.runtime.manager import Manager
from autotuner.runtime.tuning import Tuning
from autotuner.service.access import LOCAL
from autotuner.service.history import Analyses
from autotuner.service.metrics import Metrics
from autotuner.service.repeats import Repeats
from autotuner.store.archive import Archive
from autotuner.store.past import PastTuning

Seen = Tuning | PastTuning


async def _manager(request: Request) -> Manager:
    return cast("Manager", request.app.state.manager)


ManagerOf = Annotated[Manager, Depends(_manager)]


async def _floor(request: Request) -> Floor:
    return cast("Floor", request.app.state.floor)


FloorOf = Annotated[Floor, Depends(_floor)]


async def _archive(request: Request) -> Archive:
    return cast("Archive", request.app.state.archive)


ArchiveOf = Annotated[Archive, Depends(_archive)]


async def _metrics(request: Request) -> Metrics:
    return cast("Metrics", request.app.state.metrics)


MetricsOf = Annotated[Metrics, Depends(_metrics)]


async def _actor(request: Request) -> str:
    return str(request.scope.get("actor", LOCAL))


ActorOf = Annotated[str, Depends(_actor)]
"""Who asks: the name of a token, or `local` where none is needed."""


async def _seen(tuning_id: str, manager: ManagerOf, archive: ArchiveOf) -> Seen:
    if (tuning := manager.tunings.get(tuning_id)) is not None:
        return tuning
    return await archive.find(tuning_id) or manager.tuning(tuning_id)


SeenOf = Annotated[Seen, Depends(_seen)]
"""A tuning to look at: of this run of the service, or of an earlier one."""


async def _analyses(request: Request) -> Analyses:
    return cast("Analyses", request.app.state.analyses)


async def _analysis(
    seen: SeenOf, manager: ManagerOf, analyses: Annotated[Analyses, Depends(_analyses)]
) -> Analysis | None:
    return seen.analysis if isinstance(seen, Tuning) else await analyses.of(seen, manager.arithmetic)


AnalysisOf = Annotated[Analysis | None, Depends(_analysis)]
"""What the tuning's recording told; that of an earlier run is computed again."""


async def _tuning(seen: SeenOf) -> Tuning:
    if isinstance(seen, Tuning):
        return seen
    raise TuningStateError(
        "is of an earlier run of the service: it can be looked at, and other gains computed from it",
        field="tuning",
        value=seen.id,
        remedy="Write its gains by autotuner apply LOOP --from FILE with what GET /v1/tunings/ID tells, or tune again.",
    )


TuningOf = Annotated[Tuning, Depends(_tuning)]


async def _repeats(request: Request) -> Repeats:
    return cast("Repeats", request.app.state.repeats)


RepeatsOf = Annotated[Repeats, Depends(_repeats)]


async def _upload_turn(request: Request) -> Lock:
    return cast("Lock", request.app.state.upload_turn)


UploadTurn = Annotated[Lock, Depends(_upload_turn)]
"""Held by the one uploaded recording that is worked on: the other worker stays free for tunings."""
