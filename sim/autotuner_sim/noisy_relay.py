"""One relay test whose relay sees samples of the PV with noise, event by event.

    reading_i = y(i dt) + e_i,   the relay switches at a sample whose reading is beyond its threshold

The PV moves exactly between two arrivals of the relay's output, as `quick_swings` says, whatever the samples. All noise
is given, so its extremes are known: a sample from which the PV has farther to go to the threshold than the largest of
it cannot switch. Those are passed over in closed form (a single lag) or by the PV at wide spacing (second order, where
between two points `h` apart it bends by at most `max |z''| h^2/8`, and `z^2 + v^2` never grows); only the rest is read.

Rule of this file: what is passed over is certain not to switch, so the switches are those of a loop over all samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_motion import Creeping, Ringing
from autotuner_sim.quick import coefficients
from autotuner_sim.quick_swings import finder, free_motion
from autotuner_sim.relay import Knot, Relay, RelayRun

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped

Numbers = NDArray[np.float64]
State = tuple[float, float]

_READ = 128
"""Samples read at once."""
_LOOKED_AT = 128
"""Points at wide spacing looked at once."""
_BEND = 0.05
"""Wide spacing, in units in which the PV bends by at most an eighth of its square."""


@dataclass(frozen=True, slots=True)
class SampledRun:
    """One relay test by samples.

    Attributes
    ----------
    plant, relay
        What was tested, with what.
    sample_time_s : float
        From one sample to the next, s.
    starts_high : bool
        The first position, taken at sample 0.
    switches : tuple of int
        Samples at which the relay switched.
    """

    plant: Fopdt | SopdtOverdamped | SopdtUnderdamped
    relay: Relay
    sample_time_s: float
    starts_high: bool
    switches: tuple[int, ...]

    @property
    def switches_s(self) -> list[float]:
        """Times of the switches, s from the start."""
        return [k * self.sample_time_s for k in self.switches]

    @property
    def period_s(self) -> float:
        """Length of the last full period, s."""
        return (self.switches[-1] - self.switches[-3]) * self.sample_time_s

    def course(self) -> RelayRun:
        """Return the exact course of the PV, which knows it at any time and between any two."""
        motion, relay, D = self.plant.motion(), self.relay, self.plant.D
        times = [0.0, *self.switches_s]
        levels = [relay.level(is_high=self.starts_high == (k % 2 == 0)) for k in range(len(times))]
        knots = [Knot(0.0, motion.rest, 0.0)]
        for t, level in zip(times, levels, strict=True):
            last = knots[-1]
            knots.append(Knot(t + D, motion.move(last.state, last.u, t + D - last.t), level))
        return RelayRun(self.plant, relay, np.array(times), np.array(levels), tuple(knots), times[-1])


def noisy_relay(
    plant: Fopdt | SopdtOverdamped | SopdtUnderdamped,
    relay: Relay,
    noise: Sequence[float] | Numbers,
    sample_time_s: float,
    switches: int | None = None,
) -> SampledRun:
    """Run a relay test from rest.

    Parameters
    ----------
    plant : Fopdt, SopdtOverdamped or SopdtUnderdamped
        The plant, at rest until `t = 0`.
    relay : Relay
        The relay, which takes its first position at sample 0: the high one unless the reading forbids it.
    noise : array of float, shape (N,)
        What is added to the PV at each sample, PV; such as `rng.normal(0.0, sigma, N)`. The test ends with it.
    sample_time_s : float
        From one sample to the next, s.
    switches : int, optional
        The test ends earlier, with this many switches.

    Returns
    -------
    SampledRun
        Its switches may be few or none.

    Raises
    ------
    ValueError
        The noise is not finite, or the sample time not positive.
    """
    noise, sample_time_s = checked_noise(noise), checked_sample_time(sample_time_s)
    course = _Course(plant, relay, noise, (float(noise.max()), float(noise.min())), sample_time_s)
    course.run(noise.size if switches is None else switches)
    return SampledRun(plant, relay, sample_time_s, course.starts_high, tuple(course.taken[1:]))


def checked_noise(noise: ArrayLike) -> Numbers:
    """Return noise as an array of shape (N,); raise `ValueError` where it is none."""
    row = np.asarray(noise, dtype=np.float64)
    if row.ndim != 1 or not row.size or not math.isfinite(float(row.max()) - float(row.min())):
        raise ValueError("noise must be a row of finite numbers, one a sample (zeros for none).")
    return row


def checked_sample_time(sample_time_s: float) -> float:
    """Return a sample time, s; raise `ValueError` where it is none."""
    if not (sample_time_s > 0.0 and math.isfinite(sample_time_s)):
        raise ValueError(f"sample_time_s must be positive (got {sample_time_s!r}). Give the time between two samples.")
    return sample_time_s


class _Course:
    """A run as far as it is known; times count samples. `taken` is when each position was."""

    def __init__(
        self,
        plant: Fopdt | SopdtOverdamped | SopdtUnderdamped,
        relay: Relay,
        noise: Numbers,
        most: tuple[float, float],
        sample_time_s: float,
    ) -> None:
        self.noise, self.most = noise, most
        self.D = plant.D / sample_time_s
        m, n = coefficients(plant)
        self.free: _Free = _Second(m, n, sample_time_s) if m else _First(n, sample_time_s)
        threshold, way = relay.threshold(is_high=True)
        self.starts_high = way * (float(noise[0]) - threshold) <= 0.0
        positions = (True, False) if self.starts_high else (False, True)
        self.ends = [plant.K * relay.level(is_high=is_high) for is_high in positions]
        self.thresholds = [relay.threshold(is_high=is_high) for is_high in positions]
        self.taken = [0]

    def run(self, switches: int) -> None:
        """Go on to the end, or to that many switches."""
        level, state, begun, sample, arrived = 0.0, (0.0, 0.0), 0.0, 1, 0
        while sample < self.noise.size:
            start, until = self.free.move(state, sample - begun), math.inf
            first, waits = sample, True
            while waits:
                if arrived < len(self.taken):
                    until = self.taken[arrived] + self.D
                found = self._next(start, first, sample, self._end(until), level)
                waits = found is not None
                if found is not None:
                    self.taken.append(found)
                    sample = found + 1
                    if len(self.taken) > switches:
                        return
            if until == math.inf:
                return
            z, v = self.free.move(state, until - begun)
            new = self.ends[arrived % 2]
            state, level, begun, arrived = (z + level - new, v), new, until, arrived + 1
            sample = max(sample, self._end(until))

    def _end(self, until: float) -> int:
        """Return the first sample that is not before a time, or the end of all."""
        return math.ceil(until) if until < self.noise.size else self.noise.size

    def _next(self, start: State, first: int, sample: int, end: int, level: float) -> int | None:
        """Return the next sample, from `sample` to before `end`, at which the relay switches; `start` is at `first`."""
        threshold, way = self.thresholds[(len(self.taken) - 1) % 2]
        to = threshold - level
        near = to - (self.most[0] if way > 0 else self.most[1])
        while sample < end:
            sample = first + self.free.near(start, sample - first, end - first, near, way)
            if sample >= end:
                return None
            stop = min(sample + _READ, end)
            readings = self.free.ahead(self.free.move(start, sample - first), stop - sample)
            readings += self.noise[sample:stop]
            beyond = readings > to if way > 0 else readings < to
            k = int(beyond.argmax())
            if beyond[k]:
                return sample + k
            sample = stop
        return None


class _Free(Protocol):
    """The free motion of a plant, time in samples."""

    def move(self, state: State, samples: float) -> State:
        """Return the state after a time."""

    def ahead(self, state: State, samples: int) -> Numbers:
        """Return the PV at that many samples, up to `_READ`, from the state on."""

    def near(self, state: State, begin: int, end: int, level: float, way: int) -> int:
        """Return a sample from `begin` on before which the PV is not beyond the level, `end` or more if it never is."""


class _First:
    """A single lag, `z = z0 e^{-t/T}`."""

    def __init__(self, T: float, sample_time_s: float) -> None:
        self._rate = sample_time_s / T
        self._left = np.exp(-self._rate * np.arange(_READ))

    def move(self, state: State, samples: float) -> State:
        """Return the state after a time."""
        return state[0] * math.exp(-self._rate * samples), 0.0

    def ahead(self, state: State, samples: int) -> Numbers:
        """Return the PV at that many samples."""
        ahead: Numbers = state[0] * self._left[:samples]
        return ahead

    def near(self, state: State, begin: int, end: int, level: float, way: int) -> int:
        """Return the first sample at which the PV may be beyond the level."""
        z = state[0] * math.exp(-self._rate * begin)
        if way * (z - level) >= 0.0:
            return begin
        if way * level >= 0.0:
            return end
        return begin + max(int(math.log(z / level) / self._rate), 0)


class _Second:
    """A plant of second order, by `z` and `v` in units of `1/w0`."""

    def __init__(self, m: float, n: float, sample_time_s: float) -> None:
        w0 = 1.0 / math.sqrt(m)
        self._zeta, self._step = 0.5 * n * w0, sample_time_s * w0
        free = free_motion(self._zeta)
        self._motion, self._again = free.motion, free.again
        self._shrinks = math.exp(-self._zeta * free.again)
        self._passes = finder(free, 0.0, 1.0)
        self._guesses: dict[int, float] = {}
        self._bends = 1.0 + 2.0 * self._zeta
        self._wide = int(_BEND / (self._step * math.sqrt(self._bends)))
        self._table = self._of(self._step, _READ)
        self._wide_table = self._of(self._step * self._wide, _LOOKED_AT)

    def _of(self, step: float, count: int) -> tuple[Numbers, Numbers]:
        """Return what `z` and `v` are multiplied with for the PV that many steps on."""
        zeta = np.array([self._zeta])
        t = step * np.arange(count, dtype=np.float64)
        c, o = (Creeping(zeta) if self._zeta >= 1.0 else Ringing(zeta)).motion(t)
        return c + zeta * o, o

    def move(self, state: State, samples: float) -> State:
        """Return the state after a time."""
        (z, v), (c, o) = state, self._motion(self._step * samples)
        return (c + self._zeta * o) * z + o * v, (c - self._zeta * o) * v - o * z

    def ahead(self, state: State, samples: int) -> Numbers:
        """Return the PV at that many samples."""
        (z, v), (by_z, by_v) = state, self._table
        ahead: Numbers = z * by_z[:samples]
        ahead += v * by_v[:samples]
        return ahead

    def near(self, state: State, begin: int, end: int, level: float, way: int) -> int:
        """Return a sample before which the PV is not beyond the level."""
        z, v = self.move(state, begin)
        if way * (z - level) >= 0.0:
            return begin
        toward = way * v > 0.0
        if not toward and way * level > self._shrinks * math.sqrt(z * (z + 2.0 * self._zeta * v) + v * v):
            return end
        found = self._passes(z, v, level, self._guesses.get(way, 0.0))
        if found is None or found[1] * way <= 0.0 or found[0] >= self._again * (1.0 if toward else 2.0):
            near = self._looked_for(state, begin, end, level, way)
            self._guesses[way] = (near - begin) * self._step
            return near
        self._guesses[way] = found[0]
        return begin + int(found[0] / self._step)

    def _looked_for(self, state: State, begin: int, end: int, level: float, way: int) -> int:
        """Return the same by the PV at wide spacing."""
        (by_z, by_v), wide = self._wide_table, self._wide
        while begin < end and wide > 1:
            z, v = self.move(state, begin)
            bend = self._bends * math.hypot(z, v) * (self._step * wide) ** 2 / 8.0
            pv = z * by_z
            pv += v * by_v
            beyond = pv > level - bend if way > 0 else pv < level + bend
            k = int(beyond.argmax())
            if beyond[k]:
                return begin + max(k - 1, 0) * wide
            begin += (_LOOKED_AT - 1) * wide
        return begin
