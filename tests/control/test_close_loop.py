"""The closing of a loop: its own controller takes over without a bump, or everything goes back to what was found."""

import asyncio
import math

import pytest

from autotuner.control.driving.own_controller import SIGNALS
from autotuner.control.operations.close_loop import CloseLoop
from autotuner.control.operations.operation import Station
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.core.verdict import Outcome, aborted
from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner_drivers.simulated import create
from tests.control.conftest import loop_table

pytestmark = [pytest.mark.virtual_time, pytest.mark.asyncio]
CALM = {"kp": 1.0, "ti": 12.0, "td": 0.0}
WILD = {"kp": 40.0, "ti": 0.5, "td": 0.0}
PLANT = {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}


def station(gains, **device):
    backend = create({"plant": PLANT, "output0": 40.0, "pv0": 80.0, "noise": 0.05, "seed": 3, "gains": gains, **device})
    loop = loop_table()
    ledger = GainsLedger(None, "heater", in_place=True)
    return Station("heater", loop, backend, ledger, None, lambda _: None)


async def stands(backend):
    await backend.open()
    return await backend.read(SIGNALS)


async def test_a_loop_in_manual_is_closed_at_its_pv_without_a_bump():
    place = station(CALM, set_point=20.0)
    verdict = await CloseLoop().begin(place).run()
    seen = await stands(place.backend)
    assert verdict.outcome is Outcome.DONE
    assert seen[AUTO] == 1.0
    assert seen[SET_POINT] == pytest.approx(80.0, abs=0.15)
    assert seen[PV] == pytest.approx(80.0, abs=0.5)
    assert seen[OUTPUT] == pytest.approx(40.0, abs=0.5)


async def test_a_loop_that_does_not_settle_is_left_as_it_was_found():
    place = station(WILD, set_point=75.0)
    verdict = await CloseLoop().begin(place).run()
    seen = await stands(place.backend)
    assert verdict.outcome is not Outcome.DONE
    assert verdict.remedy
    assert (seen[AUTO], seen[OUTPUT], seen[SET_POINT]) == (0.0, 40.0, 75.0)


async def test_an_abort_leaves_the_loop_as_it_was_found():
    place = station(CALM, set_point=75.0)
    operation = CloseLoop().begin(place)
    running = asyncio.create_task(operation.run())
    await asyncio.sleep(9.0)
    operation.abort(aborted("stopped", "stopped", "Start again."))
    verdict = await running
    seen = await stands(place.backend)
    assert verdict.outcome is not Outcome.DONE
    assert (seen[AUTO], seen[OUTPUT], seen[SET_POINT]) == (0.0, 40.0, 75.0)


async def test_a_loop_in_auto_is_left_as_it_is():
    place = station(CALM, set_point=80.0, auto=True)
    assert (await CloseLoop().begin(place).run()).outcome is Outcome.DONE
    assert (await stands(place.backend))[SET_POINT] == 80.0


async def test_a_device_without_a_mode_cannot_be_closed():
    place = station(CALM)
    place.backend.__class__ = type("NoMode", (type(place.backend),), {"writable": frozenset({OUTPUT})})
    with pytest.raises(DriverError, match="set_point, auto"):
        await CloseLoop().begin(place).run()


async def test_a_device_that_does_not_tell_its_output_is_not_touched():
    place = station(CALM, set_point=75.0)
    read, written = place.backend.read, []

    async def without_output(names):
        return {name: math.nan if name == OUTPUT else value for name, value in (await read(names)).items()}

    async def write(values):
        written.append(values)

    place.backend.read, place.backend.write = without_output, write
    with pytest.raises(DriverError, match="its present output"):
        await CloseLoop().begin(place).run()
    assert not written
