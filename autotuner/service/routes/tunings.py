"""`/v1/tunings`: starting, following up and ending them."""

import math
from contextlib import suppress
from operator import itemgetter
from typing import Annotated

from fastapi import APIRouter, Query, Response

from autotuner.application.computing.computations import gains_for
from autotuner.application.manager import KEPT
from autotuner.application.tuning_run import TuningRequest
from autotuner.core.verdict import aborted
from autotuner.errors import (
    InputError,
    LoopBusyError,
    ShuttingDownError,
    StorageError,
    TuningStateError,
    UnknownLoopError,
    UnknownTuningError,
)
from autotuner.service.context import (
    ActorOf,
    AnalysisOf,
    ArchiveOf,
    ComputationsOf,
    IdempotencyKeysOf,
    ManagerOf,
    SeenOf,
    TuningOf,
    tuning_seen,
)
from autotuner.service.events.notifications import listed, listed_archived, path_of, tuning_resource
from autotuner.service.problems import accepted, documented
from autotuner.service.schemas import requests, resources

router = APIRouter(prefix="/v1", tags=["tunings"])

AS_CONFIGURED = requests.TuningStart()
BALANCED = requests.GainsChoice()
NOT_YET_KEPT = math.inf
"""Number of a tuning that is so new that the archive has not seen it; it may not be able to."""


@router.post(
    "/loops/{loop:path}/tunings",
    status_code=202,
    responses=accepted("tuning")
    | documented(UnknownLoopError, LoopBusyError, InputError, ShuttingDownError, StorageError),
)
async def start_tuning(
    loop: str,
    manager: ManagerOf,
    keys: IdempotencyKeysOf,
    archive: ArchiveOf,
    actor: ActorOf,
    response: Response,
    body: requests.TuningStart = AS_CONFIGURED,
    idempotency_key: requests.IdempotencyKey = None,
) -> resources.Tuning:
    """Start a tuning: the output of the loop is taken over until it ends, and then restored.

    With an `Idempotency-Key` it is started once, however often the request arrives.
    """
    whole = f"{loop} {body.model_dump_json()}"
    settings = manager.configuration.loop(loop).experiment_settings(**body.overrides())
    request = TuningRequest(settings, body.structure, body.spec(), actor, body.budget_ms)
    await archive.room()

    async def start(tuning_id: str | None = None) -> str:
        return manager.start(loop, request, apply=body.apply, verify=body.verify, tuning_id=tuning_id).id

    async def is_known(tuning_id: str) -> bool:
        return tuning_id in manager.tunings or await archive.find(tuning_id) is not None

    if idempotency_key is None:
        tuning_id = await start()
    else:
        tuning_id = await keys.once(idempotency_key, whole, manager.new_id, start, is_known)
    tuning = await tuning_seen(tuning_id, manager, archive)
    response.headers["Location"] = path_of(tuning.id)
    return tuning_resource(tuning)


@router.get("/tunings", responses=documented(UnknownLoopError, InputError))
async def list_tunings(
    manager: ManagerOf,
    archive: ArchiveOf,
    loop: Annotated[str | None, Query(description="Of this loop only.")] = None,
    limit: Annotated[int, Query(ge=1, le=KEPT)] = KEPT,
) -> resources.Tunings:
    """List the tunings, the newest first; those of earlier runs of the service are among them."""
    if loop is not None:
        manager.configuration.loop(loop)
    present = manager.newest_first()
    chosen = [
        (archive.number_of(tuning.id) or NOT_YET_KEPT, listed(tuning))
        for tuning in present
        if loop in {None, tuning.loop}
    ]
    with suppress(StorageError):  # `/readyz` reports it, and so does the start of a tuning
        archived = await archive.listed(loop, limit, {tuning.id for tuning in present})
        chosen += [(tuning.number, listed_archived(tuning)) for tuning in archived]
    newest_first = sorted(chosen, key=itemgetter(0), reverse=True)
    return resources.Tunings(tunings=[row for _, row in newest_first[:limit]])


@router.get("/tunings/{tuning_id}", responses=documented(UnknownTuningError))
async def get_tuning(tuning: SeenOf) -> resources.Tuning:
    """Return a tuning; a failed one has a verdict with the reason and the remedy."""
    return tuning_resource(tuning)


@router.post("/tunings/{tuning_id}/abort", status_code=202, responses=documented(UnknownTuningError, TuningStateError))
async def abort_tuning(tuning: TuningOf) -> resources.Tuning:
    """End a running tuning: its output is restored at once; or a verification: gains and set point go back."""
    tuning.abort(aborted("requested", "the tuning was aborted on request", "Start it again when wanted."))
    return tuning_resource(tuning)


@router.post("/tunings/{tuning_id}/gains", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def compute_gains(
    tuning: SeenOf, analysis: AnalysisOf, computations: ComputationsOf, body: requests.GainsChoice = BALANCED
) -> resources.Gains:
    """Compute other gains from the identified model; the loop is not touched."""
    if analysis is None or analysis.identification.model is None:
        raise TuningStateError(
            "has identified no process", field="tuning", value=tuning.id, remedy="Take one that ended with a model."
        )
    chosen = await computations.run(
        gains_for,
        analysis.identification,
        body.spec(),
        analysis.sample_time_s,
        analysis.context.device,
        analysis.installed,
        analysis.context.output_span,
    )
    return resources.Gains.model_validate(chosen.to_dict())
