"""What the endpoints stand on: the manager, the floor where its loops run, and the tuning that a path names."""

from asyncio import Lock
from typing import Annotated, cast

from fastapi import Depends, Request

from autotuner.runtime.floor import Floor
from autotuner.runtime.manager import Manager
from autotuner.runtime.tuning import Tuning
from autotuner.service.repeats import Repeats


async def _manager(request: Request) -> Manager:
    return cast("Manager", request.app.state.manager)


ManagerOf = Annotated[Manager, Depends(_manager)]


async def _floor(request: Request) -> Floor:
    return cast("Floor", request.app.state.floor)


FloorOf = Annotated[Floor, Depends(_floor)]


async def _tuning(tuning_id: str, manager: ManagerOf) -> Tuning:
    return manager.tuning(tuning_id)


TuningOf = Annotated[Tuning, Depends(_tuning)]


async def _repeats(request: Request) -> Repeats:
    return cast("Repeats", request.app.state.repeats)


RepeatsOf = Annotated[Repeats, Depends(_repeats)]


async def _upload_turn(request: Request) -> Lock:
    return cast("Lock", request.app.state.upload_turn)


UploadTurn = Annotated[Lock, Depends(_upload_turn)]
"""Held by the one uploaded recording that is worked on: the other worker stays free for tunings."""
