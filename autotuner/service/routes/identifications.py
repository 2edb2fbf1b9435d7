"""`/v1/identifications`: a process model from an uploaded recording."""

from typing import Annotated

from fastapi import APIRouter, Query, Request

from autotuner.service import asked, shown
from autotuner.service.context import ManagerOf, UploadTurn
from autotuner.service.routes.uploads import REFUSALS, csv_body, uploaded
from autotuner.service.work import identify_csv

PATH = "/v1/identifications"

router = APIRouter(prefix=PATH, tags=["identifications"])


@router.post(
    "", responses=REFUSALS, openapi_extra=csv_body("A recording with the header t,u,y and optionally sp, in UTF-8.")
)
async def identify(
    request: Request, manager: ManagerOf, turn: UploadTurn, choice: Annotated[asked.IdentificationChoice, Query()]
) -> shown.Identification:
    """Identify a process from a recording: relay test, step, or any other that moves the output."""
    content = await uploaded(request)
    async with turn:
        told = await manager.arithmetic.run(
            identify_csv,
            content,
            choice.columns(),
            choice.structure,
            choice.known_gain,
            choice.wish(),
            choice.points,
            choice.moments,
            choice.window_s(),
            tuple(choice.disturbance),
        )
    return shown.Identification.model_validate(told)
