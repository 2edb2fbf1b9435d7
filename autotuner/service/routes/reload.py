"""`/v1/reload`: the configuration file again, while the service runs."""

from fastapi import APIRouter, Request

from autotuner.errors import ConfigurationError, InputError, ShuttingDownError
from autotuner.service.context import ManagerOf
from autotuner.service.problems import documented
from autotuner.service.schemas import operation

router = APIRouter(prefix="/v1", tags=["health"])


@router.post("/reload", responses=documented(InputError, ShuttingDownError))
async def reload_configuration(request: Request, manager: ManagerOf) -> operation.Reloaded:
    """Read the configuration file again: loops are added, changed and removed; one that a tuning holds stays as it is.

    An error in the file changes nothing.
    """
    read = request.app.state.read_configuration
    if read is None:
        raise ConfigurationError(
            "is not known", field="file", remedy="Start the service by autotuner serve --config FILE."
        )
    configuration = read()
    change = await manager.reload(configuration)
    return operation.Reloaded.model_validate(change.to_dict())
