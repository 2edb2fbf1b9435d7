"""A device for the fault bench: a simulated loop behind a line on which anything can go wrong.

The line is asked before every call and may wait, raise, or change what a read tells. Beside it an observer writes down
what is really going on, at every sample: it asks the plant, not the line.
"""

import asyncio

from autotuner.errors import LinkError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT

READABLE = frozenset({PV, OUTPUT, SET_POINT, AUTO})
WRITABLE = frozenset({OUTPUT, AUTO})


class Line:
    """A line without faults; the faults are its children."""

    async def call(self, kind, now_s):
        """Wait or raise before a call of `kind`: open, read or write."""

    def told(self, seen, _now_s):
        """Return what a read tells."""
        return seen


class BenchDevice:
    """Implements `autotuner.ports.Backend` on an `autotuner_sim.devices.loop_device.LoopDevice`.

    `plant` is the one inside of `device`; `epoch_s` is its time at the start of the running event loop.
    """

    def __init__(self, device, plant, line):
        self.device, self.plant, self.line, self.epoch_s = device, plant, line, 0.0
        self.readable, self.writable = READABLE, WRITABLE
        self.written = []
        self.trace = []
        self._opened = False

    def now_s(self):
        return self.epoch_s + asyncio.get_running_loop().time()

    def present(self):
        self.device.advance(self.now_s())
        return self.device

    async def open(self):
        if not self._opened:
            await self.line.call("open", self.now_s())
        self._opened = True

    async def close(self):
        self._opened = False

    async def read(self, names):
        await self._call("read")
        device = self.present()
        values = {
            PV: device.measure(),
            OUTPUT: device.output,
            SET_POINT: device.set_point,
            AUTO: float(device.auto),
        }
        return {name: self.line.told(values, self.now_s())[name] for name in names}

    async def write(self, values):
        await self._call("write")
        device = self.present()
        for name, value in values.items():
            if name == AUTO:
                device.auto = bool(value)
            else:
                device.command(value)
            self.written.append((self.now_s(), name, value))

    async def _call(self, kind):
        if not self._opened:
            raise LinkError("the device is not open", remedy="Open it first.")
        await self.line.call(kind, self.now_s())

    async def observe(self, period_s):
        """Write down time, true PV, output and mode, until cancelled."""
        while True:
            device = self.present()
            self.trace.append((self.now_s(), self.plant.pv, device.output, device.auto))
            await asyncio.sleep(period_s)
