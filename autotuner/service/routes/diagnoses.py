"""`/v1/diagnoses`: what a model lacks that an uploaded recording shows."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from autotuner.errors import InputError, RecordingError
from autotuner.service.context import ManagerOf, UploadTurn
from autotuner.service.diagnosis import Diagnosis, DiagnosisChoice
from autotuner.service.errors import BodyTooLargeError, MediaTypeError
from autotuner.service.problems import documented
from autotuner.service.routes.identifications import check_kind
from autotuner.service.work import diagnose_csv

PATH = "/v1/diagnoses"

router = APIRouter(prefix=PATH, tags=["diagnoses"])


@router.post(
    "",
    responses=documented(BodyTooLargeError, MediaTypeError, RecordingError, InputError),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "A recording with the header t,u,y, in UTF-8; further columns are measured disturbances.",
            "content": {"text/csv": {"schema": {"type": "string"}}},
        }
    },
)
async def diagnose(
    request: Request, manager: ManagerOf, turn: UploadTurn, choice: Annotated[DiagnosisChoice, Query()]
) -> Diagnosis:
    """Name what the model lacks, with sizes, and the errors before and after; the model is identified unless given."""
    check_kind(request)
    try:
        content = await request.body()
    except ClientDisconnect as error:
        raise HTTPException(400, "the upload was broken off") from error
    async with turn:
        told = await manager.arithmetic.run(diagnose_csv, content, choice.columns(), choice.declared(), choice.points)
    return Diagnosis.model_validate(told)
