"""`/v1/identifications` and `/v1/diagnoses`: identification and diagnosis of an uploaded CSV recording."""

from typing import Annotated, Any

from fastapi import APIRouter, Query
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

from autotuner.errors import InputError, RecordingError
from autotuner.service.computations import diagnose_csv, identify_csv
from autotuner.service.context import ComputationsOf
from autotuner.service.errors import BodyTooLargeError, MediaTypeError
from autotuner.service.problems import documented
from autotuner.service.schemas import requests, views
from autotuner.service.schemas.diagnosis import Diagnosis, DiagnosisChoice

IDENTIFICATIONS, DIAGNOSES = "/v1/identifications", "/v1/diagnoses"
MEDIA_TYPES = ("text/csv", "text/plain")
REFUSALS = documented(BodyTooLargeError, MediaTypeError, RecordingError, InputError)

identifications = APIRouter(prefix=IDENTIFICATIONS, tags=["identifications"])
diagnoses = APIRouter(prefix=DIAGNOSES, tags=["diagnoses"])


def csv_body(description: str) -> dict[str, Any]:
    """Return the part of an endpoint's description that is about its body."""
    schema = {"schema": {"type": "string"}}
    return {"requestBody": {"required": True, "description": description, "content": {"text/csv": schema}}}


@identifications.post(
    "", responses=REFUSALS, openapi_extra=csv_body("A recording with the header t,u,y and optionally sp, in UTF-8.")
)
async def identify(
    request: Request, computations: ComputationsOf, choice: Annotated[requests.IdentificationChoice, Query()]
) -> views.Identification:
    """Identify a process from a recording: relay test, step, or any other that moves the output."""
    async with computations.upload() as turn:
        content = await uploaded(request)
        async with turn:
            result = await computations.run(
                identify_csv,
                content,
                choice.columns(),
                choice.structure,
                choice.known_gain,
                choice.spec(),
                choice.points,
                choice.moments,
                choice.window_s(),
                tuple(choice.disturbance),
            )
    return views.Identification.model_validate(result)


@diagnoses.post(
    "",
    responses=REFUSALS,
    openapi_extra=csv_body("A recording with the header t,u,y, in UTF-8; further columns are measured disturbances."),
)
async def diagnose(
    request: Request, computations: ComputationsOf, choice: Annotated[DiagnosisChoice, Query()]
) -> Diagnosis:
    """Find effects that the model lacks, and the errors before and after; the model is identified unless given."""
    async with computations.upload() as turn:
        content = await uploaded(request)
        async with turn:
            result = await computations.run(
                diagnose_csv, content, choice.columns(), choice.declared(), choice.points, choice.time_limit_s
            )
    return Diagnosis.model_validate(result)


async def uploaded(request: Request) -> bytes:
    """Return the body; refuse anything but a plain and complete CSV upload."""
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
