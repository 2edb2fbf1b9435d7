"""Stability of a loop with dead time, counted on its exact frequency response.

With `f = 1 + L(jw)`, process poles `P` right of the axis and `q` poles of `L` at the origin, the closed loop is stable
when (Nyquist; the contour passes the origin on its right)

    P - (1/pi) [arg f] from w = 0+ to infinity + q/2 = 0

Frequencies rad/s.

Invariants: the path is followed on a grid that is refined where a step is large against the distance from -1;
outside of the grid, closed forms are used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.arrays import ComplexArray, FloatArray
    from autotuner.core.model.process import ProcessModel

POINTS_PER_DECADE = 60
"""Frequencies per decade before the dead time's even step takes over; corners of lags are smooth on this scale."""
DECADES = 4
"""Decades of the grid beyond the outermost corner frequencies."""
WIDEST = 10
"""Most decades between corner frequencies: a lag at a faster corner is negligible."""
TURNS = 40
"""Turns of the dead time's phasor that are resolved with an even step."""
EVEN_STEP_RAD = 0.1
"""Turn of the dead time's phasor between two frequencies, rad: an arc of it differs from its chord by 0.1 %."""
LARGEST_STEP = 0.3
"""Largest step as a share of the distance from -1, so that a path passes -1 on the correct side."""
REFINEMENTS = 48
"""Halvings of an interval next to -1: 2^-48 of it is the rounding of its ends."""


def frequency_grid(model: ProcessModel, gains: PidGains, even_step_rad: float = EVEN_STEP_RAD) -> FloatArray:
    """Return frequencies (rad/s, increasing) that resolve the loop: its corners by decades, its dead time by turns."""
    r = model.rational()
    times = [time for time in (gains.Ti, gains.Td, gains.Tf, model.D) if 0.0 < time < math.inf]
    corners = [*_corners(r.a), *_corners(r.b), *(1.0 / time for time in times)] or [1.0]
    high = min(max(corners), min(corners) * 10.0**WIDEST) * 10.0**DECADES
    low = min(corners) / 10.0**DECADES
    grid = np.geomspace(low, high, math.ceil(POINTS_PER_DECADE * math.log10(high / low)))
    if model.D > 0.0:
        even = np.arange(1, round(TURNS * 2.0 * math.pi / even_step_rad)) * even_step_rad / model.D
        grid = np.concatenate((grid, even))
    return np.unique(grid)


def resolved(loop: Callable[[FloatArray], ComplexArray], w: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Return the grid and the loop on it, refined where a step of `L` is large against its distance from -1."""
    L = loop(w)
    for _ in range(REFINEMENTS):
        distance = np.abs(1.0 + L)
        coarse = np.flatnonzero(np.abs(np.diff(L)) > LARGEST_STEP * np.minimum(distance[1:], distance[:-1]))
        if coarse.size == 0:
            break
        between = np.sqrt(w[coarse] * w[coarse + 1])
        w, L = np.insert(w, coarse + 1, between), np.insert(L, coarse + 1, loop(between))
    return w, L


def _corners(polynomial: tuple[float, ...]) -> list[float]:
    """Return the magnitudes of the roots of `c0 + c1 s + ...`, none at the origin or out of sight."""
    if len(polynomial) > 3:
        # Equal lags come out of the roots spread by a few per cent, which does not matter to a grid.
        return [float(size) for size in np.abs(np.roots(polynomial[::-1])) if size > 0.0]
    signed = (*polynomial, 0.0)[:3]
    c0, c1, c2 = (abs(c) for c in signed)
    discriminant = c1 * c1 - 4.0 * signed[0] * signed[2]
    if discriminant < 0.0:
        return [math.sqrt(c0 / c2)]
    larger = (c1 + math.sqrt(discriminant)) / 2.0
    roots = [larger / c2 if c2 else 0.0, c0 / larger if larger else 0.0]
    return [root for root in roots if 0.0 < root < math.inf]


@dataclass(frozen=True, slots=True)
class PathEnds:
    """Path of `1 + L` outside of the grid: start towards w = 0, poles, and the loop gain at infinity."""

    integrators: int
    dc_gain: float
    low_gain: float
    unstable_poles: int
    tail: float
    delayed: bool

    def times(self, k: float) -> PathEnds:
        """Return the path of `1 + k L`."""
        return replace(self, low_gain=k * self.low_gain, tail=k * self.tail)

    @property
    def start(self) -> complex:
        """The direction of `1 + L` for w -> 0."""
        if self.integrators == 0:
            return complex(1.0 + self.low_gain)
        return self.low_gain * (-1j) ** self.integrators

    @property
    def Mt_at_rest(self) -> float:
        """`|T|` for w -> 0."""
        return 1.0 if self.integrators else abs(self.low_gain / (1.0 + self.low_gain))

    @property
    def noise_gain_at_rest(self) -> float:
        """`|R|` for w -> 0."""
        return self.Mt_at_rest / abs(self.dc_gain)

    @property
    def start_on_negative_axis(self) -> tuple[float, ...]:
        """`-L(0)` when `L` starts on the negative real axis."""
        return (-self.low_gain,) if self.integrators == 0 and self.low_gain < 0.0 else ()


def path_ends(model: ProcessModel, gains: PidGains) -> PathEnds:
    """Return the path outside of the grid."""
    r = model.rational()
    integrating = r.a[0] == 0.0
    lowest = r.b[0] / (r.a[1] if integrating else r.a[0])
    integral = math.isfinite(gains.Ti)
    return PathEnds(
        integrators=integrating + integral,
        dc_gain=math.inf if integrating else lowest,
        low_gain=lowest * (gains.Ki if integral else gains.Kp),
        unstable_poles=_right_half_plane_roots(r.a),
        tail=_loop_tail(model, gains),
        delayed=model.D > 0.0,
    )


@lru_cache(maxsize=16)
def _right_half_plane_roots(a: tuple[float, ...]) -> int:
    """Return how many roots of `a0 + a1 s + ...` lie right of the imaginary axis; of order 2 by signs (Routh)."""
    if len(a) > 3:
        return int(np.count_nonzero(np.roots(a[::-1]).real > 0.0))
    chain = [c for c in a[::-1] if c != 0.0]
    return sum(x * y < 0.0 for x, y in pairwise(chain))


def _loop_tail(model: ProcessModel, gains: PidGains) -> float:
    """Return the loop gain at infinite frequency, sign included; the dead time turns it for ever."""
    r = model.rational()
    numerator = r.b if r.b[1] != 0.0 else r.b[:1]
    denominator = r.poles_polynomial()
    excess = len(denominator) - len(numerator)
    excess += (2 if gains.Tf > 0.0 else 0) - (1 if gains.Td > 0.0 and math.isinf(gains.N) else 0)
    if excess > 0:
        return 0.0
    high = gains.Td if math.isinf(gains.N) else 1.0 + gains.N
    leading = gains.Kp * (high if gains.Td > 0.0 else 1.0)
    leading *= numerator[-1] / denominator[-1] / (gains.Tf**2 / 2.0 or 1.0)
    return leading if excess == 0 else math.copysign(math.inf, leading)


def controller_tail(gains: PidGains) -> float:
    """Return `|C F|` at infinite frequency."""
    if gains.Tf > 0.0:
        return 0.0
    return abs(gains.Kp) * (1.0 + gains.N if gains.Td > 0.0 else 1.0)


def encircles_nothing(ends: PathEnds, L: ComplexArray) -> bool:
    """Return whether Nyquist's criterion holds: no closed-loop pole right of the axis."""
    if math.isinf(ends.tail) or (ends.delayed and abs(ends.tail) >= 1.0) or ends.start == 0.0:
        return False
    end = 1.0 if ends.delayed else 1.0 + ends.tail
    path = np.concatenate(([ends.start], 1.0 + L, [end]))
    if not np.all(path):
        return False
    return round(ends.unstable_poles - turned(path) / math.pi + ends.integrators / 2.0) == 0


def turned(path: ComplexArray) -> float:
    """Return the angle by which a path turns around 0, rad: that of its ends, and a turn for each time it passes left.

    Parameters
    ----------
    path : array of complex, shape (n,)
        Points of the path, none at 0, each less than half a turn from the one before.
    """
    below = path.imag < 0.0
    at = np.flatnonzero(below[1:] != below[:-1])
    p, q, upwards = path[at], path[at + 1], below[at]
    passes_left = (p.real * q.imag - p.imag * q.real < 0.0) == upwards
    turns = np.count_nonzero(passes_left & ~upwards) - np.count_nonzero(passes_left & upwards)
    first, last = (math.atan2(end.imag + 0.0, end.real) for end in (path[0], path[-1]))  # -0 is on the same side as 0
    return last - first + 2.0 * math.pi * turns
