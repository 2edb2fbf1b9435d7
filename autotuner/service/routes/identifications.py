"""`/v1/identifications`: a process model from an uploaded recording."""

from typing import Annotated

from fastapi import APIRouter, Query, Request

from autotuner.service.computations import identify_csv
from autotuner.service.context import ComputationsOf
from autotuner.service.routes.uploads import REFUSALS, csv_body, uploaded
from autotuner.service.schemas import requests, views

PATH = "/v1/identifications"

router = APIRouter(prefix=PATH, tags=["identifications"])


@router.post(
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
