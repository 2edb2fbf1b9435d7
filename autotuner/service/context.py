"""What the endpoints stand on: the manager, the floor where its loops run, and the tuning that a path names."""

from asyncio import Lock
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Annotated, Any

from fastapi import Depends, Request

from autotuner.errors import TuningStateError
from autotuner.runtime.analysed import Analysis
from autotuner.runtime.floor import Floor
from autotuner.runtime.manager import Manager
from autotuner.runtime.tuning import Tuning
from autotuner.service.access import LOCAL
from autotuner.service.fan import Fans
from autotuner.service.history import Analyses
from autotuner.service.metrics import Metrics
from autotuner.service.repeats import Repeats
from autotuner.store.archive import Archive
from autotuner.store.keeper import since_of
from autotuner.store.past import PastTuning

Seen = Tuning | PastTuning


def kept(name: str) -> Callable[[Request], Awaitable[Any]]:
    """Return a dependency: what the application keeps in its state under a name."""

    async def found(request: Request) -> Any:
        return getattr(request.app.state, name)

    return found


ManagerOf = Annotated[Manager, Depends(kept("manager"))]


FloorOf = Annotated[Floor, Depends(kept("floor"))]


ArchiveOf = Annotated[Archive, Depends(kept("archive"))]


FansOf = Annotated[Fans, Depends(kept("fans"))]


MetricsOf = Annotated[Metrics, Depends(kept("metrics"))]


async def _actor(request: Request) -> str:
    return str(request.scope.get("actor", LOCAL))


ActorOf = Annotated[str, Depends(_actor)]
"""Who asks: the name of a token, or `local` where none is needed."""


async def tuning_seen(tuning_id: str, manager: ManagerOf, archive: ArchiveOf) -> Seen:
    """Return a tuning of this run of the service, or of an earlier one; raise `UnknownTuningError` for none.

    Of one whose verification alone was left to this run the database knows more.
    """
    tuning = manager.tunings.get(tuning_id)
    if tuning is not None and not tuning.ended_before:
        return tuning
    past = await archive.find(tuning_id)
    if past is None or not past.kept.told:
        return manager.tuning(tuning_id)
    return past if tuning is None else replace(past, since=since_of(tuning))


SeenOf = Annotated[Seen, Depends(tuning_seen)]
"""A tuning to look at: of this run of the service, or of an earlier one."""


async def _analysis(
    seen: SeenOf, manager: ManagerOf, analyses: Annotated[Analyses, Depends(kept("analyses"))]
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


RepeatsOf = Annotated[Repeats, Depends(kept("repeats"))]


UploadTurn = Annotated[Lock, Depends(kept("upload_turn"))]
"""Held by the one uploaded recording that is worked on: the other worker stays free for tunings."""
