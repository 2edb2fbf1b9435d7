"""Whether the service runs, whether it takes work, and what its problems mean."""

from fastapi import APIRouter

from autotuner.errors import ShuttingDownError
from autotuner.service import schemas
from autotuner.service.context import ManagerOf
from autotuner.service.problems import PROBLEMS, TYPES, UNEXPECTED, documented

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> schemas.Health:
    """Tell that the process answers."""
    return schemas.Health()


@router.get("/readyz", responses=documented(ShuttingDownError))
async def readyz(manager: ManagerOf) -> schemas.Health:
    """Tell that tunings can be started."""
    if manager.closing:
        raise ShuttingDownError
    return schemas.Health()


@router.get(TYPES)
async def list_problem_types() -> list[schemas.ProblemType]:
    """List the kinds of problems that this service tells; `type` of a problem points here."""
    return [
        schemas.ProblemType(type=row.type, title=row.title, status=row.status)
        for row in (*PROBLEMS.values(), UNEXPECTED)
    ]
