"""`/v1/loops`: what can be tuned."""

from typing import TYPE_CHECKING
from urllib.parse import quote

from fastapi import APIRouter

from autotuner.errors import UnknownLoopError
from autotuner.service import schemas
from autotuner.service.context import ManagerOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.runtime.manager import Manager

router = APIRouter(prefix="/v1/loops", tags=["loops"])


@router.get("")
async def list_loops(manager: ManagerOf) -> schemas.Loops:
    """List the configured loops."""
    return schemas.Loops(loops=[_loop(manager, name) for name in manager.configuration.loops])


@router.get("/{loop:path}", responses=documented(UnknownLoopError))
async def get_loop(loop: str, manager: ManagerOf) -> schemas.Loop:
    """Return one loop."""
    return _loop(manager, loop)


def _loop(manager: "Manager", name: str) -> schemas.Loop:
    table, holder = manager.configuration.loop(name), manager.running(name)
    path = f"{router.prefix}/{quote(name, safe='')}"
    return schemas.Loop(
        name=name,
        driver=table.driver,
        sample_time_s=table.sample_time_s,
        action=table.action,
        pv_unit=table.pv_unit,
        output_unit=table.output_unit,
        limits=table.limits,
        relay=table.relay,
        gains=table.gains,
        tuning_id=None if holder is None else holder.id,
        links=schemas.LoopLinks(self=path, tunings=f"{path}/tunings", gains=f"{path}/gains"),
    )
