"""A CSV recording as the body of a request: how it is described, and how it is taken."""

from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

from autotuner.errors import InputError, RecordingError
from autotuner.service.errors import BodyTooLargeError, MediaTypeError
from autotuner.service.problems import documented

MEDIA_TYPES = ("text/csv", "text/plain")
REFUSALS = documented(BodyTooLargeError, MediaTypeError, RecordingError, InputError)


def csv_body(description: str) -> dict[str, Any]:
    """Return the part of an endpoint's description that is about its body."""
    schema = {"schema": {"type": "string"}}
    return {"requestBody": {"required": True, "description": description, "content": {"text/csv": schema}}}


async def uploaded(request: Request) -> bytes:
    """Return the body; refuse what is not a plain CSV upload, or was broken off."""
    _check_kind(request)
    try:
        return await request.body()
    except ClientDisconnect as error:
        raise HTTPException(400, "the upload was broken off") from error


def _check_kind(request: Request) -> None:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    encoding = request.headers.get("content-encoding", "identity").lower()
    if kind not in MEDIA_TYPES or encoding != "identity":
        raise MediaTypeError(
            "is not a plain CSV upload",
            field="Content-Type",
            value=f"{kind}; {encoding}",
            remedy="Send the file as it is, with the header Content-Type: text/csv.",
        )
