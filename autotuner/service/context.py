"""What the endpoints stand on: the manager, and the loop or tuning that a path names."""

# No `from __future__ import annotations`: the framework reads the annotations of this module when it runs.

from typing import Annotated, cast

from fastapi import Depends, Request

from autotuner.runtime.manager import Manager
from autotuner.runtime.tuning import Tuning


async def _manager(request: Request) -> Manager:
    return cast("Manager", request.app.state.manager)


ManagerOf = Annotated[Manager, Depends(_manager)]


async def _tuning(tuning_id: str, manager: ManagerOf) -> Tuning:
    return manager.tuning(tuning_id)


TuningOf = Annotated[Tuning, Depends(_tuning)]
