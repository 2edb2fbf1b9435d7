"""Liveness, readiness, metrics and problem types of the service."""

from typing import Annotated

from fastapi import APIRouter, Query, Response
from prometheus_client import CONTENT_TYPE_LATEST

from autotuner.errors import DriverError, InputError, LinkError, ShuttingDownError, StorageError, UnknownLoopError
from autotuner.service.context import ArchiveOf, ManagerOf, MetricsOf
from autotuner.service.operations.links import links_of
from autotuner.service.problems import PROBLEMS, TYPES, UNEXPECTED, documented
from autotuner.service.schemas import operation

router = APIRouter(tags=["health"])

STATES = {"up": True, "down": False, "unknown": None}


@router.get("/healthz")
async def healthz() -> operation.Health:
    """Report that the process answers."""
    return operation.Health()


@router.get("/readyz", responses=documented(ShuttingDownError, StorageError, UnknownLoopError, InputError, DriverError))
async def readyz(
    manager: ManagerOf,
    archive: ArchiveOf,
    loop: Annotated[str | None, Query(description="Only this loop, whose device must answer.")] = None,
) -> operation.Readiness:
    """Report that tunings can be started and stored, and whether each loop's device answered at its last poll."""
    if manager.closing:
        raise ShuttingDownError
    if loop is not None:
        manager.configuration.loop(loop)
    await archive.room()
    links = [link for link in links_of(manager) if loop in {None, link.loop}]
    down = [link for link in links if link.link == "down"]
    if loop is not None and down:
        reason = (down[0].error or "").rstrip(".")  # with what to do about it
        raise LinkError(f"does not answer: {reason}", field=loop, remedy="Ask again when that is done.")
    return operation.Readiness(status="degraded" if down else "ok", loops=links)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "The numbers", "content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def get_metrics(manager: ManagerOf, archive: ArchiveOf, metrics: MetricsOf) -> Response:
    """Return the counters, in the text format of Prometheus."""
    links = links_of(manager)
    metrics.count(reversed(manager.newest_first()))
    metrics.show(
        ((link.loop, link.tuning_id is not None, STATES[link.link]) for link in links), store=await archive.is_usable()
    )
    metrics.show_unknown(list(manager.left.unknown))
    return Response(metrics.text(), media_type=CONTENT_TYPE_LATEST)


@router.get(TYPES)
async def list_problem_types() -> list[operation.ProblemType]:
    """List the kinds of problems that this service reports; `type` of a problem points here."""
    return [
        operation.ProblemType(type=row.type, title=row.title, status=row.status)
        for row in (*PROBLEMS.values(), UNEXPECTED)
    ]
