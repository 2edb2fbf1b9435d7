"""A run over operating points while the configuration is read again, or the service ends: its set point comes back."""

import asyncio

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.manager import Manager
from autotuner.application.schedule_run import SchedulePlan
from autotuner.application.tuning_run import TuningRequest
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.ports import AUTO, SET_POINT
from tests.control.conftest import Faulty, loop_table

SLOW_S = 1.0


class Scene:
    """A manager with one loop in auto whose device takes some seconds for a write of the set point."""

    def __init__(self, folder):
        self.loop, self.written = loop_table({"auto": True}), []
        self.device = Faulty(make_backend("simulated", self.loop.device, "loops.x"), self._slow)
        self.manager = Manager(self.configuration(folder), InPlace())
        self.manager._furnish("TIC-101", self.loop, self.device)
        request = TuningRequest(self.loop.experiment_settings(check=False), "fopdt")
        self.run = self.manager.schedules.start("TIC-101", SchedulePlan((70.0, 90.0), request))

    def configuration(self, folder, **loops):
        service = {"data_directory": str(folder)}
        own = {"TIC-101": self.loop.model_dump(exclude_none=True)}
        return parse_configuration({"service": service, "loops": {**own, **loops}}, "test")

    async def _slow(self, call, _number, names):
        if call == "write" and SET_POINT in names:
            self.written.append(asyncio.get_running_loop().time())
            await asyncio.sleep(SLOW_S)

    async def in_the_release(self):
        """Abort the run on its way to the first point; return in the middle of the write that restores."""
        while not self.written:  # noqa: ASYNC110 - a device rings no bell
            await asyncio.sleep(1.0)
        await asyncio.sleep(SLOW_S + 1.0)
        self.manager.schedules.abort(self.run.id)
        while len(self.written) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.1)

    async def seen(self):
        await self.device.inner.open()
        return await self.device.inner.read([SET_POINT, AUTO])


@pytest.mark.parametrize("other", ["reload", "close"])
def test_the_release_of_the_set_point_is_waited_for(tmp_path, virtual, other):
    async def main():
        one = Scene(tmp_path)
        await one.in_the_release()
        assert one.run.verdict is None
        if other == "reload":
            change = await one.manager.reload(one.configuration(tmp_path, new=one.loop.model_dump(exclude_none=True)))
            assert change.added == ("new",)
            while one.run.verdict is None:  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        await one.manager.close()
        return one, await one.seen()

    one, seen = virtual(main())
    assert seen == {SET_POINT: 80.0, AUTO: 1.0}
    assert one.run.verdict.code == "requested"


def test_a_loop_whose_set_point_is_moved_keeps_its_table(tmp_path, virtual):
    async def main():
        one = Scene(tmp_path)
        await one.in_the_release()
        changed = {**one.loop.model_dump(exclude_none=True), "sample_time_s": 2.0 * one.loop.sample_time_s}
        change = await one.manager.reload(one.configuration(tmp_path, **{"TIC-101": changed}))
        await one.manager.close()
        return change

    assert virtual(main()).held == ("TIC-101",)
