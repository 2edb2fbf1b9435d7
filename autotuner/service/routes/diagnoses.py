"""`/v1/diagnoses`: what a model lacks that an uploaded recording shows."""

from typing import Annotated

from fastapi import APIRouter, Query, Request

from autotuner.service.computations import diagnose_csv
from autotuner.service.context import ComputationsOf
from autotuner.service.routes.uploads import REFUSALS, csv_body, uploaded
from autotuner.service.schemas.diagnosis import Diagnosis, DiagnosisChoice

PATH = "/v1/diagnoses"

router = APIRouter(prefix=PATH, tags=["diagnoses"])


@router.post(
    "",
    responses=REFUSALS,
    openapi_extra=csv_body("A recording with the header t,u,y, in UTF-8; further columns are measured disturbances."),
)
async def diagnose(
    request: Request, computations: ComputationsOf, choice: Annotated[DiagnosisChoice, Query()]
) -> Diagnosis:
    """Name what the model lacks, with sizes, and the errors before and after; the model is identified unless given."""
    async with computations.upload() as turn:
        content = await uploaded(request)
        async with turn:
            result = await computations.run(
                diagnose_csv, content, choice.columns(), choice.declared(), choice.points, choice.time_limit_s
            )
    return Diagnosis.model_validate(result)
