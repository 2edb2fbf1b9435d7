"""Several loops of one Modbus device that are tuned at once over its one connection. Virtual time.

The device holds a plant for each loop behind its registers; its truth is read past the line.
"""

import asyncio

import pytest

from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.control.driving.controller import Controller
from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner.core.verdict import aborted

TRIP_S = 0.004
LOST = ("device_gone", "device_error", "pv_lost")
SCALE = 0.02
REST = 40.0
START = {"output0": REST, "pv0": 80.0, "noise": 0.05}
PLANT = {"structure": "fopdt", "T": 4.0, "D": 0.6}
GAINS = (2.0, 1.2, 0.7)
"""Static gains of the plants: each loop has to find its own."""


class PlantDevice:
    """Loop `k` has PV and output in the holding registers `2 k` and `2 k + 1`; a silent device takes nothing."""

    def __init__(self, gains=GAINS):
        self.plants = [
            make_backend("simulated", START | {"plant": PLANT | {"K": K}, "seed": k}, f"loops.{k}")
            for k, K in enumerate(gains)
        ]
        self.spans, self.silent = [], False

    async def __call__(self, _served, frame, writer):
        function, address, value = frame[7], int.from_bytes(frame[8:10], "big"), int.from_bytes(frame[10:12], "big")
        await asyncio.sleep(TRIP_S)
        if self.silent:
            return
        if function == 6:
            await self.plants[address // 2].write({"output": signed(value) * SCALE})
            pdu = frame[7:12]
        else:
            self.spans.append((address, value))
            words = []
            for k in range(address // 2, -(-(address + value) // 2)):
                seen = await self.plants[k].read(["pv", "output"])
                words += [round(seen[name] / SCALE) & 0xFFFF for name in ("pv", "output")]
            words = words[address % 2 :][:value]
            pdu = bytes([3, 2 * len(words)]) + b"".join(word.to_bytes(2, "big") for word in words)
        writer.write(frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu)

    async def open(self):
        for plant in self.plants:
            await plant.open()

    async def outputs(self):
        return [(await plant.read(["output"]))["output"] for plant in self.plants]


def signed(word):
    return word - 0x10000 if word >= 0x8000 else word


class Tuned:
    """A loop of the device, with its tuning."""

    def __init__(self, number):
        table = {
            "driver": "modbus",
            "sample_time_s": 0.1,
            "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
            "relay": {"amplitude": 10.0, "check": False, "quiet_s": 3.0},
            "device": {
                "host": "device",
                "port": 1502,
                "timeout_s": 0.3,
                "registers": {
                    "pv": {"table": "holding", "address": 2 * number, "scale": SCALE},
                    "output": {"table": "holding", "address": 2 * number + 1, "scale": SCALE},
                },
            },
        }
        self.loop = parse_configuration({"loops": {"L": table}}, "test").loop("L")
        self.backend = make_backend("modbus", self.loop.device, "loops.L")
        self.verdict = None

    async def conduct(self, after_s):
        await asyncio.sleep(after_s)
        self.controller = Controller(self.backend, self.loop.experiment_settings(), self.loop, lambda _: None)
        self.verdict = await self.controller.run()


@pytest.fixture
def tuned(virtual, scripted_device):
    """Return a function that tunes all loops of a device while `during(device, loops, served)` goes on."""

    def run(during, device=None):
        async def main():
            plants = device or PlantDevice()
            await plants.open()
            loops = [Tuned(k) for k in range(len(plants.plants))]
            async with scripted_device(plants).serving() as served:
                tasks = [asyncio.ensure_future(one.conduct(0.37 * k)) for k, one in enumerate(loops)]
                await during(plants, loops, served)
                await asyncio.gather(*tasks)
                connections = served.connections
            return plants, loops, connections, await plants.outputs()

        return virtual(main())

    return run


async def moving(device):
    """Wait until the relay drives every loop."""
    for _ in range(10_000):
        if all(abs(output - REST) > 5.0 for output in await device.outputs()):
            return
        await asyncio.sleep(0.1)
    raise AssertionError("the relays never began")


def test_each_loop_is_tuned_as_if_it_were_alone(tuned):
    async def nothing(*_):
        pass

    device, loops, connections, outputs = tuned(nothing)
    assert connections == 1
    assert [one.verdict for one in loops] == [None] * 3
    for K, one in zip(GAINS, loops, strict=True):
        recording = Recording.from_samples(one.controller.samples)
        assert pytest.approx(K, rel=0.03) == identify(recording, "fopdt").model.K
    assert [one.controller.restored for one in loops] == [True] * 3
    assert outputs == pytest.approx([REST] * 3, abs=SCALE)
    joint = sum(span == (0, 6) for span in device.spans)
    assert joint > 0.5 * sum(span[0] == 0 for span in device.spans)  # the tunings end one after another


def test_an_abort_of_one_leaves_the_others_to_their_end(tuned):
    async def abort_the_second(device, loops, _served):
        await moving(device)
        loops[1].controller.abort(aborted("requested", "by the test", ""))
        await asyncio.sleep(0.2)
        assert (await device.outputs())[1] == pytest.approx(REST, abs=SCALE)

    _, loops, _, outputs = tuned(abort_the_second)
    assert [one.verdict and one.verdict.code for one in loops] == [None, "requested", None]
    assert outputs == pytest.approx([REST] * 3, abs=SCALE)


@pytest.mark.parametrize("lost_s", [0.8, 30.0])
@pytest.mark.parametrize("how", ["silent", "gone"])
def test_every_loop_of_a_device_that_was_lost_is_restored(tuned, how, lost_s):
    """Short losses end no tuning; after a long one each output is back within seconds of the device's return."""

    async def lose(device, _loops, served):
        await moving(device)
        device.silent = True
        if how == "gone":
            served.hang_up()
        await asyncio.sleep(lost_s)
        device.silent = False
        if lost_s > 10.0:
            await asyncio.sleep(6.0)
            assert await device.outputs() == pytest.approx([REST] * 3, abs=SCALE)

    _, loops, _, outputs = tuned(lose)
    assert all(one.verdict is None if lost_s < 1.0 else one.verdict.code in LOST for one in loops)
    assert [one.controller.restored for one in loops] == [True] * 3
    assert outputs == pytest.approx([REST] * 3, abs=SCALE)
