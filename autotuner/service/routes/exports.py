"""`/v1/tunings/{id}/export`: a tuning as one file, for `autotuner replay`; `/v1/audit`: the audit."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from autotuner.errors import InputError, StorageError, UnknownTuningError
from autotuner.service.archive.archived_tuning import ArchivedTuning
from autotuner.service.archive.archiver import kept_now
from autotuner.service.archive.export import exported
from autotuner.service.context import ArchiveOf, ComputationsOf, SeenOf
from autotuner.service.problems import documented
from autotuner.service.schemas import operation

router = APIRouter(prefix="/v1", tags=["history"])

MOST = 1000
"""Most entries of the audit in one answer."""
JSON = "application/json"
FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {JSON: {"schema": {"type": "object", "additionalProperties": True}}}}
}


@router.get(
    "/tunings/{tuning_id}/export",
    response_class=Response,
    responses=FILE | documented(UnknownTuningError, StorageError),
)
async def export_tuning(tuning: SeenOf, computations: ComputationsOf, archive: ArchiveOf) -> Response:
    """Return a tuning as one file: settings, recording, events, result, versions, and the SHA-256 of all of it."""
    kept = tuning.kept if isinstance(tuning, ArchivedTuning) else kept_now(tuning)
    changes = await archive.gains(tuning.id)
    text = await computations.run(exported, kept, changes)
    name = f'attachment; filename="tuning-{tuning.id}.json"'
    return Response(text, media_type=JSON, headers={"Content-Disposition": name})


@router.get("/audit", responses=documented(InputError, StorageError))
async def list_audit(
    archive: ArchiveOf,
    limit: Annotated[int, Query(ge=1, le=MOST)] = 100,
    before: Annotated[int | None, Query(ge=1, le=2**53, description="Older than the entry of this number.")] = None,
    loop: Annotated[str | None, Query(max_length=200, description="What was done to this loop only.")] = None,
    actor: Annotated[str | None, Query(max_length=200, description="What this one did only.")] = None,
) -> operation.Audit:
    """Return the audit, the newest entry first; no entry can be changed or deleted."""
    return operation.Audit.model_validate({"entries": await archive.audit(limit, before, loop, actor)})
