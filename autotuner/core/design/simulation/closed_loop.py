"""Simulation of a closed loop: the discrete controller on the exact process.

    x' = A x + B u(t - D),   y = C x + E u(t - D)

`u` is held between samples, so with `D = n h + f` each interval is two pieces of constant input, `u[k-n-1]` for `f` and
`u[k-n]` for the rest, and the state moves exactly by matrix exponentials (Van Loan, IEEE Trans. Autom. Control 23,
1978). The load is added at the process input.

`t` s, PV and output as deviations from the rest before the step.

Invariants: exact except for the controller's own sampling; an element between controller and process
(a dead band, a saturation) is a function of the output and may have its own state.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from operator import mul
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.design.simulation.pid import Interval, PidSettings, started
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

Actuator = Callable[[float], float]
"""Function from the commanded to the acting output, called once in each sample."""
SETTLED = 0.02
"""Band of the settling time, share of the largest deviation."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Scenario of a simulation.

    Attributes
    ----------
    duration_s, sample_time_s : float
        Length of the simulation and sample time of the controller, s.
    set_point_step : float
        Step of the set point at `t = 0`, PV units.
    load_step : float
        Step of the load at the process input at `t = 0`, output units.
    """

    duration_s: float
    sample_time_s: float
    set_point_step: float = 0.0
    load_step: float = 0.0

    def __post_init__(self) -> None:
        for name in ("duration_s", "sample_time_s"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise InputError(
                    "must be a positive time", field=f"scenario.{name}", value=value, remedy="Give seconds above 0."
                )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A simulated response; arrays of shape (N,), deviations from rest.

    Attributes
    ----------
    t : array of float
        Times of the samples, s.
    set_point, pv, output : array of float
        Set point, measured PV and commanded output.
    """

    t: FloatArray
    set_point: FloatArray
    pv: FloatArray
    output: FloatArray

    @property
    def error(self) -> FloatArray:
        """Set point minus PV."""
        return self.set_point - self.pv

    @property
    def iae(self) -> float:
        """Integral of the absolute error, PV s."""
        return float(np.trapezoid(np.abs(self.error), self.t))

    @property
    def overshoot(self) -> float:
        """Largest excess of the PV over the last set point, as a share of its step; 0 without overshoot."""
        target = float(self.set_point[-1])
        return max(0.0, float(np.max(self.pv / target)) - 1.0) if target else 0.0

    @property
    def settling_time_s(self) -> float:
        """Time from which the error stays within 2 % of its largest value, s."""
        outside = np.flatnonzero(np.abs(self.error) > SETTLED * np.max(np.abs(self.error)))
        return float(self.t[outside[-1]]) if outside.size else 0.0


def predict(
    model: ProcessModel,
    settings: PidSettings,
    scenario: Scenario,
    *,
    actuator: Actuator | None = None,
    noise: FloatArray | None = None,
) -> Prediction:
    """Return the response of the loop from rest.

    Parameters
    ----------
    model : ProcessModel
        The process.
    settings : PidSettings
        The controller; limits and slew count from the output at rest.
    scenario : Scenario
        Steps of set point and load, duration and sample time.
    actuator : callable, optional
        What acts between the commanded output and the process.
    noise : array of float, shape (N,), optional
        Measurement noise at the samples, PV units.
    """
    h = scenario.sample_time_s
    count = max(2, math.ceil(scenario.duration_s / h) + 1)
    act: Actuator = actuator or (lambda output: output)
    process = _HeldProcess(model, h)
    measured_noise = [0.0] * count if noise is None else np.resize(noise, count).tolist()
    state, interval = started(settings, -h, 0.0, 0.0, 0.0), Interval.of(settings, h)
    pv, output = [], []  # numbers of Python: one at a time they are cheaper than those of an array
    for k in range(count):
        pv.append(process.pv + measured_noise[k])
        state = interval.after(state, k * h, pv[k], scenario.set_point_step)
        output.append(state.output)
        process.advance(act(state.output) + scenario.load_step)
    set_point = np.full(count, scenario.set_point_step)
    return Prediction(np.arange(count, dtype=np.float64) * h, set_point, np.array(pv), np.array(output))


class _HeldProcess:
    """A process at rest, moved from sample to sample by held inputs.

    One product moves it: the state after both pieces is `P2 P1 x + P2 g1 u[k-n-1] + g2 u[k-n]`.
    """

    def __init__(self, model: ProcessModel, h: float) -> None:
        A, B, C, E = _state_space(model)
        whole = math.floor(model.D / h)
        rest = model.D - whole * h
        (P1, g1), (P2, g2) = _held(A, B, rest), _held(A, B, h - rest)
        self.moves: list[list[float]] = np.column_stack((P2 @ P1, P2 @ g1, g2)).tolist()
        self.reads = [*C.tolist(), 0.0, E]
        self.state = [0.0] * B.size
        self.inputs = deque([0.0] * (whole + 2), maxlen=whole + 2)
        self.pv = 0.0

    def advance(self, u: float) -> None:
        """Move one sample on, under the input `u` from now on."""
        self.inputs.append(u)
        before = (*self.state, self.inputs[0], self.inputs[1])
        self.state = [sum(map(mul, row, before)) for row in self.moves]
        self.pv = sum(map(mul, self.reads, (*self.state, *before[-2:])))


def _state_space(model: ProcessModel) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return `A`, `B`, `C`, `E` of the delay-free part in controllable form."""
    r = model.rational()
    a = np.array(r.poles_polynomial())
    order = a.size - 1
    if order == 1:
        pole = -r.a[0] / r.a[1]
        C = np.array([r.b[0] + r.b[1] * pole])
        return np.array([[pole]]), np.array([1.0 / r.a[1]]), C, r.b[1] / r.a[1]
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = -a[:-1] / a[-1]
    return A, np.append(np.zeros(order - 1), 1.0 / a[-1]), np.append(r.b, np.zeros(order - 2)), 0.0


def _held(A: FloatArray, B: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Return `e^{A h}` and the integral of `e^{A s} B` over `h`."""
    n = B.size
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n] = A * h, B * h
    whole = scipy.linalg.expm(augmented)
    return whole[:n, :n], whole[:n, n]
