"""`/v1/tunings`: starting, following up and ending them."""

from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Query, Response

from autotuner.core.phases import Phase
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
from autotuner.runtime.analysis import gains_for
from autotuner.runtime.manager import KEPT
from autotuner.runtime.tuning import TuningRequest
from autotuner.service import asked, schemas
from autotuner.service.context import FloorOf, ManagerOf, RepeatsOf, TuningOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.runtime.tuning import Tuning

router = APIRouter(prefix="/v1", tags=["tunings"])

AS_CONFIGURED = asked.TuningStart()
BALANCED = asked.GainsChoice()
STARTED: dict[int | str, dict[str, Any]] = {
    202: {"headers": {"Location": {"description": "Path of the tuning.", "schema": {"type": "string"}}}}
}


@router.post(
    "/loops/{loop:path}/tunings",
    status_code=202,
    responses=STARTED | documented(UnknownLoopError, LoopBusyError, InputError, ShuttingDownError, StorageError),
)
async def start_tuning(
    loop: str,
    manager: ManagerOf,
    floor: FloorOf,
    repeats: RepeatsOf,
    response: Response,
    body: asked.TuningStart = AS_CONFIGURED,
    idempotency_key: asked.IdempotencyKey = None,
) -> schemas.Tuning:
    """Start a tuning: the output of the loop is taken over until it ends, and then given back.

    With an `Idempotency-Key` it is started once, however often the request arrives.
    """
    whole = f"{loop} {body.model_dump_json()}"
    settings = manager.configuration.loop(loop).experiment_settings(**body.overrides())
    request = TuningRequest(settings, body.structure, body.goal, body.rule)

    def start() -> str:
        return manager.start(loop, request, apply=body.apply, verify=body.verify).id

    tuning = manager.tuning(await floor.do(lambda: repeats.once(idempotency_key, whole, start)))
    response.headers["Location"] = _path(tuning)
    return _told(tuning)


@router.get("/tunings", responses=documented(UnknownLoopError, InputError))
async def list_tunings(
    manager: ManagerOf,
    loop: Annotated[str | None, Query(description="Of this loop only.")] = None,
    limit: Annotated[int, Query(ge=1, le=KEPT)] = KEPT,
) -> schemas.Tunings:
    """List the tunings, the newest first."""
    if loop is not None:
        manager.configuration.loop(loop)
    chosen = [tuning for tuning in manager.newest_first() if loop in {None, tuning.loop}]
    return schemas.Tunings(tunings=[_listed(tuning) for tuning in chosen[:limit]])


@router.get("/tunings/{tuning_id}", responses=documented(UnknownTuningError))
async def get_tuning(tuning: TuningOf) -> schemas.Tuning:
    """Return a tuning; one that ran and failed has a verdict that says why and what to do."""
    return _told(tuning)


@router.post("/tunings/{tuning_id}/abort", status_code=202, responses=documented(UnknownTuningError, TuningStateError))
async def abort_tuning(tuning: TuningOf, floor: FloorOf) -> schemas.Tuning:
    """End a running tuning: its output is restored at once; or a verification: gains and set point go back."""
    verdict = aborted("requested", "the tuning was aborted on request", "Start it again when wanted.")
    await floor.do(lambda: tuning.abort(verdict))
    return _told(tuning)


@router.post("/tunings/{tuning_id}/gains", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def compute_gains(tuning: TuningOf, manager: ManagerOf, body: asked.GainsChoice = BALANCED) -> schemas.Gains:
    """Compute other gains from the identified model; the loop is not touched."""
    if tuning.analysis is None or tuning.analysis.identification.model is None:
        raise TuningStateError(
            "has identified no process", field="tuning", value=tuning.id, remedy="Take one that ended with a model."
        )
    identification, sample_time_s = tuning.analysis.identification, tuning.analysis.sample_time_s
    chosen = await manager.arithmetic.run(
        gains_for, identification, body.goal, body.rule, body.tau_c_s, sample_time_s=sample_time_s
    )
    return schemas.Gains.model_validate(chosen.to_dict())


def _told(tuning: "Tuning") -> schemas.Tuning:
    return schemas.Tuning.model_validate({**tuning.to_dict(), "links": _links(tuning)})


def _listed(tuning: "Tuning") -> schemas.TuningSummary:
    return schemas.TuningSummary(
        id=tuning.id,
        loop=tuning.loop,
        state="ended" if tuning.ended else "running",
        phase=Phase(tuning.phase),
        started_at=tuning.started_at,
        outcome=tuning.verdict.outcome if tuning.verdict else None,
        code=tuning.verdict.code if tuning.verdict else None,
        links=_links(tuning),
    )


def _path(tuning: "Tuning") -> str:
    return f"{router.prefix}/tunings/{quote(tuning.id, safe='')}"


def _links(tuning: "Tuning") -> schemas.Links:
    path = _path(tuning)
    return schemas.Links(
        self=path,
        loop=f"{router.prefix}/loops/{quote(tuning.loop, safe='')}",
        events=f"{path}/events",
        recording=f"{path}/recording",
        report=f"{path}/report",
        abort=f"{path}/abort",
        gains=f"{path}/gains",
        apply=f"{path}/apply",
        verify=f"{path}/verify",
        rollback=f"{path}/rollback",
    )
