"""Sensors: white, coloured and heavy-tailed noise, resolution, spikes, freezing, an unsteady clock.

PV and readings in PV units, times in s. The same seed gives the same readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotuner_sim.effects.protocols import require_positive

DRAWN = 256
"""Random numbers drawn at once: many cost little more than one."""


class Noise:
    """White Gaussian noise of standard deviation `sigma`; the same seed gives the same readings."""

    def __init__(self, sigma: float, seed: int = 0) -> None:
        require_positive(self, "sigma", sigma)
        self._sigma = sigma
        self._random = np.random.default_rng(seed)
        self._drawn: list[float] = []

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the reading of `pv`."""
        if not self._drawn:  # many at once cost little more than one, and are the same numbers
            self._drawn = self._random.standard_normal(DRAWN)[::-1].tolist()
        return pv + self._sigma * self._drawn.pop()


@dataclass(frozen=True, slots=True)
class Quantisation:
    """A reading that knows only multiples of `step`, as a converter or a register of integers does."""

    step: float

    def __post_init__(self) -> None:
        require_positive(self, "step", self.step)

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the reading of `pv`."""
        return self.step * round(pv / self.step)


class ColouredNoise:
    """First-order noise: neighbouring readings `h` apart correlate by `e^{-h/tau}` (AR(1)); `sigma` in all."""

    def __init__(self, sigma: float, tau_s: float, seed: int = 0) -> None:
        self._sigma, self._tau_s = sigma, tau_s
        self._random = np.random.default_rng(seed)
        self._t, self._value = -math.inf, 0.0

    def read(self, pv: float, t: float) -> float:
        """Return the reading of `pv` taken at `t`."""
        decay = math.exp(-(t - self._t) / self._tau_s)
        fresh = self._sigma * math.sqrt(1.0 - decay * decay) * float(self._random.standard_normal())
        self._t, self._value = t, decay * self._value + fresh
        return pv + self._value


class HeavyTailedNoise:
    """Noise of Student's t with `freedom` > 2 degrees of freedom, scaled to standard deviation `sigma`."""

    def __init__(self, sigma: float, freedom: float = 3.0, seed: int = 0) -> None:
        self._scale, self._freedom = sigma * math.sqrt((freedom - 2.0) / freedom), freedom
        self._random = np.random.default_rng(seed)

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the reading of `pv`."""
        return pv + self._scale * float(self._random.standard_t(self._freedom))


class SendOnDelta:
    """A sensor that reports when the PV has moved by `delta` since its last report; until then that value holds."""

    def __init__(self, delta: float) -> None:
        self._delta, self._sent = delta, math.nan

    def read(self, pv: float, t: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the last reported value."""
        if not abs(pv - self._sent) < self._delta:
            self._sent = pv
        return self._sent


class Spikes:
    """Single readings that are off by `size` up or down, each with probability `chance`; `run` > 1 makes them bursts.

    A burst keeps its sign, and its readings vary by a third.
    """

    def __init__(self, size: float, chance: float, run: int = 1, seed: int = 0, from_s: float = -math.inf) -> None:
        self._size, self._chance, self._run, self._from_s = size, chance, run, from_s
        self._random = np.random.default_rng(seed)
        self._left, self._sign = 0, 1.0

    def read(self, pv: float, t: float) -> float:
        """Return the reading of `pv` taken at `t`."""
        if self._left == 0 and self._random.random() < self._chance and t >= self._from_s:
            self._left, self._sign = self._run, float(self._random.choice([-1.0, 1.0]))
        if self._left == 0:
            return pv
        self._left -= 1
        return pv + self._sign * self._size * float(self._random.uniform(2.0 / 3.0, 4.0 / 3.0))


class Freeze:
    """A sensor whose reading is frozen from `at_s` for `lasts_s`, and then follows the PV again."""

    def __init__(self, at_s: float, lasts_s: float) -> None:
        self._at_s, self._until_s, self._held = at_s, at_s + lasts_s, math.nan

    def read(self, pv: float, t: float) -> float:
        """Return the reading of `pv` taken at `t`."""
        if not self._at_s <= t < self._until_s:
            return pv
        if math.isnan(self._held):
            self._held = pv
        return self._held


class Jitter:
    """A clock that is not exact: the sample with the time stamp `t` is taken up to `most_s` later, evenly drawn.

    With `run` > 1 that many samples are late alike, as on a busy computer; `most_s` must be under the time between
    samples.
    """

    def __init__(self, most_s: float, seed: int = 0, run: int = 1) -> None:
        self._most_s, self._run = most_s, run
        self._random = np.random.default_rng(seed)
        self._left, self._late_s = 0, 0.0

    def moment(self, t: float) -> float:
        """Return when the sample of `t` is really taken, s."""
        if self._left == 0:
            self._left, self._late_s = self._run, self._most_s * float(self._random.random())
        self._left -= 1
        return t + self._late_s
