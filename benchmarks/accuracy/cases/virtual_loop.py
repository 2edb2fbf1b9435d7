"""A whole tuning of the product in virtual time, on a loop that shares no code with the product or its simulator.

    x' = A x + B (actuator(u(t - D)) + load(t)),   pv = pv0 + sensor(C x + noise)

The process moves by matrix exponentials (SciPy) from reading to reading; dead time is exact. What stands around the
process is plain Python here: load, noise, actuator and sensor.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import async_solipsism
import numpy as np

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import LoopTable
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from benchmarks.accuracy.cases.relay_record import held, state_space

if TYPE_CHECKING:
    from collections.abc import Callable

OUTPUT0, PV0 = 40.0, 50.0
GRANULARITY = 0.01
"""Share of a sample by which the clock of the virtual event loop may be early."""


def same(value: float) -> float:
    return value


def no_load(_t: float) -> float:
    return 0.0


@dataclass
class Surroundings:
    """What stands around a process; sizes in output and PV units, times in seconds from the start."""

    noise: Callable[[], float] = lambda: 0.0
    load: Callable[[float], float] = no_load
    offset: Callable[[float], float] = no_load
    actuator: Callable[[float], float] = same
    sensor: Callable[[float], float] = same
    limits: dict[str, Any] = field(default_factory=dict)
    relay: dict[str, Any] = field(default_factory=dict)
    output0: float = OUTPUT0


class Process:
    """A process of `amigo_batch`, `scale` seconds for each unit of its time, `gain` times its gain."""

    def __init__(self, process: Any, scale: float, gain: float, dt: float) -> None:
        A, B, C = state_space(process)
        self.A, self.B, self.C = A / scale, B / scale, gain * C
        self.D, self.dt = process.D * scale, dt
        whole = math.floor(self.D / dt + 1e-9)
        rest = max(0.0, self.D - whole * dt)
        self.moves = held(self.A, self.B, rest), held(self.A, self.B, dt - rest)
        self.x, self.inputs = np.zeros(B.size), [0.0] * (whole + 2)

    def advance(self, u: float) -> None:
        self.inputs = [*self.inputs[1:], u]
        for (phi, gamma), value in zip(self.moves, self.inputs[:2], strict=True):
            self.x = phi @ self.x + gamma * value

    @property
    def pv(self) -> float:
        return float(self.C @ self.x)


class Device:
    """Implements `autotuner.ports.Backend` on a process that moves from reading to reading."""

    def __init__(self, process: Process, around: Surroundings) -> None:
        self.process, self.around = process, around
        self.output, self.auto, self.k, self.measured = around.output0, False, 0, math.nan
        self.rest = around.actuator(around.output0)
        self.readable = self.writable = frozenset({PV, OUTPUT, AUTO})
        self.readable |= {SET_POINT}
        self.written: list[tuple[float, float]] = []

    async def open(self) -> None:
        pass

    async def close(self) -> None:
        pass

    async def read(self, names: frozenset[str]) -> dict[str, float]:
        self._advance()
        values = {PV: self.measured, OUTPUT: self.output, SET_POINT: PV0, AUTO: float(self.auto)}
        return {name: values[name] for name in names}

    async def write(self, values: dict[str, float]) -> None:
        self._advance()
        self.auto = bool(values.get(AUTO, self.auto))
        self.output = float(values.get(OUTPUT, self.output))
        self.written.append((asyncio.get_running_loop().time(), self.output))

    def _advance(self) -> None:
        around, dt = self.around, self.process.dt
        due = math.floor(asyncio.get_running_loop().time() / dt + GRANULARITY)
        while self.k < due:
            u = around.actuator(self.output) - self.rest
            self.process.advance(u + around.load(self.k * dt))
            self.k += 1
            self._measure()
        if math.isnan(self.measured):
            self._measure()

    def _measure(self) -> None:
        around = self.around
        self.measured = PV0 + around.sensor(self.process.pv + around.offset(self.k * self.process.dt) + around.noise())


def tuned(process: Process, around: Surroundings, *, direct: bool = True) -> TuningRun:
    """Return a tuning of the loop, from the first reading to the gains, with default settings."""
    logging.disable(logging.CRITICAL)
    table = {
        "driver": "simulated",
        "sample_time_s": process.dt,
        "process_action": "direct" if direct else "reverse",
        "limits": {"output": [0.0, 100.0], **around.limits},
        "relay": around.relay,
        "device": {"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}},
    }
    loop = LoopTable.model_validate(table)
    tuning = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings()))
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(tuning.conduct(loop, Device(process, around), InPlace()))  # type: ignore[arg-type]
    return tuning
