"""`/v1/identifications`: a process model from an uploaded recording."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from autotuner.errors import InputError, RecordingError
from autotuner.service import asked, shown
from autotuner.service.context import ManagerOf, UploadTurn
from autotuner.service.errors import BodyTooLargeError, MediaTypeError
from autotuner.service.problems import documented
from autotuner.service.work import identify_csv

PATH = "/v1/identifications"
MEDIA_TYPES = ("text/csv", "text/plain")

router = APIRouter(prefix=PATH, tags=["identifications"])


@router.post(
    "",
    responses=documented(BodyTooLargeError, MediaTypeError, RecordingError, InputError),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "A recording with the header t,u,y and optionally sp, in UTF-8.",
            "content": {"text/csv": {"schema": {"type": "string"}}},
        }
    },
)
async def identify(
    request: Request, manager: ManagerOf, turn: UploadTurn, choice: Annotated[asked.IdentificationChoice, Query()]
) -> shown.Identification:
    """Identify a process from a recording: relay test, step, or any other that moves the output."""
    check_kind(request)
    try:
        content = await request.body()
    except ClientDisconnect as error:
        raise HTTPException(400, "the upload was broken off") from error
    async with turn:
        told = await manager.arithmetic.run(
            identify_csv,
            content,
            choice.columns(),
            choice.structure,
            choice.known_gain,
            choice.goal,
            choice.rule,
            choice.points,
            choice.moments,
            choice.window_s(),
        )
    return shown.Identification.model_validate(told)


def check_kind(request: Request) -> None:
    """Refuse what is not a plain CSV upload."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    encoding = request.headers.get("content-encoding", "identity").lower()
    if kind not in MEDIA_TYPES or encoding != "identity":
        raise MediaTypeError(
            "is not a plain CSV upload",
            field="Content-Type",
            value=f"{kind}; {encoding}",
            remedy="Send the file as it is, with the header Content-Type: text/csv.",
        )
