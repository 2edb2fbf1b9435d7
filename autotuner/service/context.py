"""Dependencies of the endpoints: the manager, and the tuning of a path."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Annotated, Any

from fastapi import Depends, Request

from autotuner.application.analysis.analysed import Analysis
from autotuner.application.manager import Manager
from autotuner.application.tuning_run import TuningRun
from autotuner.errors import TuningStateError
from autotuner.service.archive.archive import Archive
from autotuner.service.archive.archived_tuning import ArchivedTuning
from autotuner.service.archive.archiver import since_of
from autotuner.service.idempotency import IdempotencyKeys
from autotuner.service.operations.compute_queue import ClientComputations, ComputeQueue
from autotuner.service.operations.history import Analyses
from autotuner.service.operations.metrics import Metrics
from autotuner.service.security.access import LOCAL

Seen = TuningRun | ArchivedTuning


def kept(name: str) -> Callable[[Request], Awaitable[Any]]:
    """Return a dependency on the application's state under a name."""

    async def found(request: Request) -> Any:
        return getattr(request.app.state, name)

    return found


ManagerOf = Annotated[Manager, Depends(kept("manager"))]


ArchiveOf = Annotated[Archive, Depends(kept("archive"))]


MetricsOf = Annotated[Metrics, Depends(kept("metrics"))]


async def _actor(request: Request) -> str:
    return str(request.scope.get("actor", LOCAL))


ActorOf = Annotated[str, Depends(_actor)]
"""Actor of a request: the name of a token, or `local` where none is needed."""


async def _computations(request: Request) -> ClientComputations:
    queue: ComputeQueue = request.app.state.compute_queue
    return queue.of(str(request.scope.get("client_key", LOCAL)))


ComputationsOf = Annotated[ClientComputations, Depends(_computations)]
"""Computations for the client of a request."""


async def tuning_seen(tuning_id: str, manager: ManagerOf, archive: ArchiveOf) -> Seen:
    """Return a tuning of this run of the service, or of an earlier one; raise `UnknownTuningError` for none.

    The database has more of a tuning whose verification alone was left to this run.
    """
    tuning = manager.tunings.get(tuning_id)
    if tuning is not None and not tuning.ended_before:
        return tuning
    archived = await archive.find(tuning_id)
    if archived is None or not archived.kept.reported:
        return manager.tuning(tuning_id)
    return archived if tuning is None else replace(archived, since=since_of(tuning))


SeenOf = Annotated[Seen, Depends(tuning_seen)]
"""A tuning to be read: of this run of the service, or of an earlier one."""


async def _analysis(
    seen: SeenOf, computations: ComputationsOf, analyses: Annotated[Analyses, Depends(kept("analyses"))]
) -> Analysis | None:
    return seen.analysis if isinstance(seen, TuningRun) else await analyses.of(seen, computations)


AnalysisOf = Annotated[Analysis | None, Depends(_analysis)]
"""The analysis of the tuning's recording; that of an earlier run is computed again."""


async def _tuning(seen: SeenOf) -> TuningRun:
    if isinstance(seen, TuningRun):
        return seen
    raise TuningStateError(
        "is of an earlier run of the service: it can be read, and other gains computed from it",
        field="tuning",
        value=seen.id,
        remedy="Write its gains by autotuner apply LOOP --from FILE (the answer of GET /v1/tunings/ID), or tune again.",
    )


TuningOf = Annotated[TuningRun, Depends(_tuning)]


IdempotencyKeysOf = Annotated[IdempotencyKeys, Depends(kept("idempotency_keys"))]
