"""How much faster than real time a whole tuning goes through the service in virtual time.

    python benchmarks/latency/virtual_time.py [--rounds N]

The service in memory, on an event loop whose clock jumps to the next timer: one tuning of a simulated process sampled
at 1 Hz is started over HTTP, asked for every ten minutes, and fetched with its recording. Identification and
diagnosis are done in place. Printed for each process: how long the tuning lasted, how long that took in processor time,
and how much of it the arithmetic (`sums`). The limit is the plant alone, sampled as often. The best round counts.
"""

import argparse
import asyncio
import logging
import tempfile
import time

import async_solipsism
import httpx

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.service.app import create_app

ASKED_S = 600.0
"""Time between two looks of the client, s."""
PLANTS = {
    "T 60 s, D 10 s": {"structure": "fopdt", "K": 2.0, "T": 60.0, "D": 10.0},
    "T 600 s, D 90 s": {"structure": "fopdt", "K": 2.0, "T": 600.0, "D": 90.0},
    "T1 3000, T2 600, D 300 s": {"structure": "sopdt_overdamped", "K": 2.0, "T1": 3000.0, "T2": 600.0, "D": 300.0},
}


class Timed(InPlace):
    """ComputePool in place that notes its time."""

    spent_s = 0.0

    async def run(self, function, /, *args, **kwargs):
        begun = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            Timed.spent_s += time.process_time() - begun


def configuration(plant, folder):
    loop = {
        "driver": "simulated",
        "sample_time_s": 1.0,
        "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
        "relay": {"amplitude": 10.0},
        "device": {"scan_s": 0.25, "plant": plant, "output0": 40.0, "pv0": 80.0, "noise": 0.05, "seed": 1},
    }
    return parse_configuration({"service": {"data_directory": folder}, "loops": {"loop": loop}}, "bench")


async def tuned(configured):
    """Return how long a tuning lasted, s, its samples and its verdict."""
    app = create_app(configured, Timed())
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost:8321") as client,
    ):
        path = (await client.post("/v1/loops/loop/tunings")).headers["location"]
        while (told := (await client.get(path)).json())["state"] != "ended":  # noqa: ASYNC110 - as a program asks
            await asyncio.sleep(ASKED_S)
        recording = (await client.get(f"{path}/recording", headers={"Accept": "application/json"})).json()
        return recording["t_s"][-1], told["samples"], told["verdict"]["code"]


async def sampled(device, count):
    """Sample a simulated device."""
    backend = make_backend("simulated", device, "bench")
    await backend.open()
    for _ in range(count):
        await backend.read(["pv", "output"])
        await asyncio.sleep(1.0)
    await backend.close()


def spent(main):
    begun = time.process_time()
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        result = runner.run(main)
    return time.process_time() - begun, result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    logging.disable()
    print(f"{'process':26} {'lasted, s':>9} {'samples':>8} {'took, s':>8} {'comp, s':>8} {'faster':>8} {'limit':>8}")
    for name, plant in PLANTS.items():
        best, limit = (float("inf"), 0.0), float("inf")
        for _ in range(args.rounds):
            with tempfile.TemporaryDirectory() as folder:
                configured = configuration(plant, folder)
                Timed.spent_s = 0.0
                took_s, (lasted_s, samples, code) = spent(tuned(configured))
                assert code == "identified", code
                best = min(best, (took_s, Timed.spent_s))
                limit = min(limit, spent(sampled(configured.loop("loop").device, samples))[0])
        faster = (f"{lasted_s / seconds:8.0f}" for seconds in (best[0], limit))
        print(f"{name:26} {lasted_s:9.0f} {samples:8} {best[0]:8.2f} {best[1]:8.2f} {' '.join(faster)}")


if __name__ == "__main__":
    main()
