"""Disturbances: stepped, ramped and periodic loads, straight and curved drift of the PV, measured disturbances.

Loads are added to the plant's input and change in steps, on a grid fine enough to be smooth; offsets are added to the
PV and are known at every time. Loads in output units, offsets in PV units, times in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEPS = 100
"""Steps of a load to its ramp or its period."""
Wave = Literal["sine", "triangle", "square"]


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load of `size` that stays from `at_s` on."""

    at_s: float
    size: float

    def load(self, t: float) -> float:
        """Return the contribution to the plant's input from `t` on."""
        return self.size if t >= self.at_s else 0.0

    def next_change_s(self, after: float) -> float:
        """Return the time of the step if it is still to come."""
        return self.at_s if after < self.at_s else math.inf


@dataclass(frozen=True, slots=True)
class Drift:
    """A PV that wanders off by `rate_per_s` from `from_s` on."""

    rate_per_s: float
    from_s: float = 0.0

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        return self.rate_per_s * max(t - self.from_s, 0.0)


def wave(shape: Wave, periods: float) -> float:
    """Return a wave of amplitude 1 after `periods` periods; all shapes start at 0 and rise."""
    angle = 2.0 * math.pi * periods
    if shape == "sine":
        return math.sin(angle)
    if shape == "square":
        return 1.0 if periods % 1.0 < 0.5 else -1.0
    return float(scipy.signal.sawtooth(angle + math.pi / 2.0, 0.5))


def _next_on_grid(after: float, start_s: float, step_s: float) -> float:
    return start_s if after < start_s else start_s + (math.floor((after - start_s) / step_s + 1e-6) + 1) * step_s


@dataclass(frozen=True, slots=True)
class LoadRamp:
    """A load that grows from 0 at `at_s` to `size` within `over_s` and stays."""

    at_s: float
    size: float
    over_s: float

    def load(self, t: float) -> float:
        """Return the contribution to the plant's input from `t` on: the ramp at the middle of the step."""
        middle_s = t + self.over_s / STEPS / 2.0
        return 0.0 if t < self.at_s else self.size * min((middle_s - self.at_s) / self.over_s, 1.0)

    def next_change_s(self, after: float) -> float:
        """Return the next step of the ramp, infinite after it."""
        return math.inf if after > self.at_s + self.over_s else _next_on_grid(after, self.at_s, self.over_s / STEPS)


@dataclass(frozen=True, slots=True)
class PeriodicLoad:
    """A load that comes and goes: `amplitude wave((t + phase)/period)`."""

    amplitude: float
    period_s: float
    shape: Wave = "sine"
    phase_s: float = 0.0

    def load(self, t: float) -> float:
        """Return the contribution to the plant's input from `t` on: the wave at the middle of the step."""
        middle_s = t + self.period_s / STEPS / 2.0
        return self.amplitude * wave(self.shape, (middle_s + self.phase_s) / self.period_s)

    def next_change_s(self, after: float) -> float:
        """Return the next step of the wave."""
        return _next_on_grid(after, 0.0, self.period_s / STEPS)


@dataclass(frozen=True, slots=True)
class PeriodicOffset:
    """A PV that is shaken: `amplitude wave((t + phase)/period)`."""

    amplitude: float
    period_s: float
    shape: Wave = "sine"
    phase_s: float = 0.0

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        return self.amplitude * wave(self.shape, (t + self.phase_s) / self.period_s)


@dataclass(frozen=True, slots=True)
class CurvedDrift:
    """A PV that wanders off and comes to rest: `size (1 - e^{-(t - from)/tau})`."""

    size: float
    tau_s: float
    from_s: float = 0.0

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        return self.size * -math.expm1(-max(t - self.from_s, 0.0) / self.tau_s)


@dataclass(frozen=True, slots=True)
class BiasStep:
    """A sensor that reads `size` more from `at_s` on: recalibrated, knocked, a connection renewed."""

    at_s: float
    size: float

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        return self.size if t >= self.at_s else 0.0


class Measured:
    """A disturbance that is measured too: `tau z' = gain d - z`, `z` added to the PV, `d` straight between its points.

    Parameters
    ----------
    t, d : array of float, shape (N,)
        The measured signal; before the first and after the last point it stays.
    gain : float
        PV units per unit of the signal.
    lag_s : float
        tau, s; 0 for none.
    """

    def __init__(self, t: NDArray[np.float64], d: NDArray[np.float64], gain: float, lag_s: float) -> None:
        self.t, self.d, self._lag_s = np.asarray(t, np.float64), np.asarray(d, np.float64), lag_s
        self._gain = gain
        self._z = self._answer() if lag_s > 0.0 else self.d - self.d[0]

    def signal(self, t: float) -> float:
        """Return the measured value at `t`."""
        return float(np.interp(t, self.t, self.d))

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""
        return self._gain * float(np.interp(t, self.t, self._z))

    def _answer(self) -> NDArray[np.float64]:
        """Return the exact first-order response at the points to the polyline between them."""
        z, d = np.zeros_like(self.d), self.d - self.d[0]
        for k, h in enumerate(np.diff(self.t)):
            slope = (d[k + 1] - d[k]) / h
            fade = math.exp(-h / self._lag_s)
            z[k + 1] = d[k + 1] - slope * self._lag_s + (z[k] - d[k] + slope * self._lag_s) * fade
        return z
