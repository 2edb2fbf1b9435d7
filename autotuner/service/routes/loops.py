"""`/v1/loops`: configured loops."""

from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from fastapi import APIRouter, Query

from autotuner.control.verification.verify import can_verify
from autotuner.errors import InputError, UnknownLoopError
from autotuner.service.context import ManagerOf
from autotuner.service.problems import documented
from autotuner.service.schemas import resources

if TYPE_CHECKING:
    from autotuner.application.monitor import Monitor
    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import LoopTable
    from autotuner.control.devices.device_polling import Reading

router = APIRouter(prefix="/v1/loops", tags=["loops"])
now = APIRouter(prefix="/v1/readings", tags=["loops"])


@router.get("")
async def list_loops(manager: ManagerOf) -> resources.Loops:
    """List the configured loops."""
    holders, loops = manager.holders(), manager.configuration.loops
    return resources.Loops(
        loops=[
            _loop(name, table, holders.get(name), can_verify(manager.device(name)[1])) for name, table in loops.items()
        ]
    )


@router.get("/{loop:path}", responses=documented(UnknownLoopError))
async def get_loop(loop: str, manager: ManagerOf) -> resources.Loop:
    """Return one loop."""
    table, backend = manager.device(loop)
    return _loop(loop, table, manager.holders().get(loop), can_verify(backend))


@now.get("", responses=documented(UnknownLoopError, InputError))
async def list_readings(
    manager: ManagerOf, loop: Annotated[str | None, Query(description="Of this loop only.")] = None
) -> resources.Readings:
    """Return the readings of the loops; an idle one is read, at most once a second, for the next call."""
    names = list(manager.configuration.loops) if loop is None else [loop]
    seen = [(name, manager.running(name), manager.reading(name), manager.monitors.of(name)) for name in names]
    return resources.Readings(readings=[_reading(*one) for one in seen])


def _reading(name: str, holder: "TuningRun | None", seen: "Reading", monitor: "Monitor | None") -> resources.Reading:
    watch = None if monitor is None else monitor.findings.code if monitor.findings else "watching"
    values = {"loop": name, "tuning_id": None if holder is None else holder.id, **seen.to_dict(), "watch": watch}
    return resources.Reading.model_validate(values)


def _loop(name: str, table: "LoopTable", holder: "TuningRun | None", verifiable: bool) -> resources.Loop:  # noqa: FBT001
    path = f"{router.prefix}/{quote(name, safe='')}"
    return resources.Loop(
        name=name,
        driver=table.driver,
        sample_time_s=table.sample_time_s,
        process_action=table.process_action,
        action=table.process_action,
        pv_unit=table.pv_unit,
        output_unit=table.output_unit,
        limits=table.limits,
        relay=table.relay,
        gains=table.gains,
        tuning_id=None if holder is None else holder.id,
        can_verify=table.gains is not None and verifiable,
        links=resources.LoopLinks(self=path, tunings=f"{path}/tunings", gains=f"{path}/gains"),
    )
