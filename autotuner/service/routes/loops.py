"""`/v1/loops`: what can be tuned."""

from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from fastapi import APIRouter, Query

from autotuner.errors import InputError, UnknownLoopError
from autotuner.service import schemas
from autotuner.service.context import FloorOf, ManagerOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.configuration import LoopTable
    from autotuner.runtime.monitor import Monitor
    from autotuner.runtime.tuning import Tuning
    from autotuner.runtime.visits import Reading

router = APIRouter(prefix="/v1/loops", tags=["loops"])
now = APIRouter(prefix="/v1/readings", tags=["loops"])


@router.get("")
async def list_loops(manager: ManagerOf) -> schemas.Loops:
    """List the configured loops."""
    holders, loops = manager.holders(), manager.configuration.loops
    return schemas.Loops(loops=[_loop(name, table, holders.get(name)) for name, table in loops.items()])


@router.get("/{loop:path}", responses=documented(UnknownLoopError))
async def get_loop(loop: str, manager: ManagerOf) -> schemas.Loop:
    """Return one loop."""
    return _loop(loop, manager.configuration.loop(loop), manager.holders().get(loop))


@now.get("", responses=documented(UnknownLoopError, InputError))
async def list_readings(
    manager: ManagerOf, floor: FloorOf, loop: Annotated[str | None, Query(description="Of this loop only.")] = None
) -> schemas.Readings:
    """Tell what the loops show now; an idle one is looked at, at most once a second, for the next call to tell."""
    names = list(manager.configuration.loops) if loop is None else [loop]
    seen = await floor.do(
        lambda: [(name, manager.running(name), manager.reading(name), manager.monitors.of(name)) for name in names]
    )
    return schemas.Readings(readings=[_reading(*one) for one in seen])


def _reading(name: str, holder: "Tuning | None", seen: "Reading", monitor: "Monitor | None") -> schemas.Reading:
    watch = None if monitor is None else monitor.findings.code if monitor.findings else "watching"
    told = {"loop": name, "tuning_id": None if holder is None else holder.id, **seen.to_dict(), "watch": watch}
    return schemas.Reading.model_validate(told)


def _loop(name: str, table: "LoopTable", holder: "Tuning | None") -> schemas.Loop:
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
