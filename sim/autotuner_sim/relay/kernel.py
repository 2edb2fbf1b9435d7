"""Relay tests of first and second order, event by event in closed form, compiled by Numba where it is installed.

    m y'' + n y' + y = K u(t - D)       a single lag for m = 0

While the input is constant, `L = K u` is where the PV is heading. With `z = y - L` and time in units of `1/w0`,
`w0^2 = 1/m`, the distance follows `z'' + 2 zeta z' + z = 0`, `zeta = n w0/2`, whose solution from `z0`, `v0` is

    z(t) = (c + zeta o) z0 + o v0        c = e^{-zeta t} cosh(d t)
    v(t) = (c - zeta o) v0 - o z0        o = e^{-zeta t} sinh(d t)/d,   d^2 = zeta^2 - 1

(`cos`, `sin` and `d^2 = 1 - zeta^2` when underdamped). The slope `v` vanishes where `o/c = v0/(zeta v0 + z0)`, so the
turning points and, for the slope's own slope, the inflection points are known. Between two turning points the PV is
monotone and passes a threshold once at most. A single lag has its time constant as unit of time, `c = e^{-t}`, `o = 0`.

Invariants: every function takes and returns numbers or fills arrays, so that one plant and thousands, exact
switches and those of noisy samples, share it; it knows no names, units or errors, `batch` does.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

Numbers = NDArray[np.float64]
Counts = NDArray[np.int64]
Plant = tuple[int, float, float]
"""Kind, damping ratio `zeta` and `d`."""
Pair = tuple[float, float]
Function = TypeVar("Function", bound="Callable[..., object]")

LAG, OVERDAMPED, UNDERDAMPED = 0, 1, 2
SMALLEST_SPLIT = 1e-100
"""`d` of a double pole, whose quotients have their limits at `d = 0`."""
STEP_TOLERANCE = 1e-9
"""Last step of the root search, relative to the time in which the slope changes: its cube is below rounding."""
MOST_STEPS = 80
"""Steps of the root search, which halves its bracket where Halley's method leaves it."""


def _numba() -> ModuleType | None:
    try:
        return import_module("numba")
    except ImportError:  # not installed, or not compatible with the installed NumPy
        return None


NUMBA = _numba()


def compiled(function: Function) -> Function:
    """Compile a function with Numba at its first call; without Numba it is plain Python with the same results.

    The machine code is cached in this folder or, where it is read-only, in the user's cache. Without a writable cache
    each process compiles again, which takes some seconds.
    """
    if NUMBA is None:
        return function
    try:
        return cast("Function", NUMBA.njit(cache=True)(function))
    except RuntimeError:  # Numba has found no folder for its cache
        return cast("Function", NUMBA.njit(function))


@compiled
def plant_of(m: float, n: float) -> tuple[int, float, float, float]:
    """Return kind, damping ratio, `d` and the rate `w0`, 1/s, of a plant."""
    if m == 0.0:
        return LAG, 0.0, 0.0, 1.0 / n
    w0 = 1.0 / math.sqrt(m)
    zeta = 0.5 * n * w0
    square = zeta * zeta - 1.0
    if square >= 0.0:
        return OVERDAMPED, zeta, math.sqrt(square) + SMALLEST_SPLIT, w0
    return UNDERDAMPED, zeta, math.sqrt(-square), w0


@compiled
def solutions(plant: Plant, t: float) -> Pair:
    """Return `c` and `o`."""
    kind, zeta, d = plant
    if kind == LAG:
        return math.exp(-t), 0.0
    if kind == UNDERDAMPED:
        decay = math.exp(-zeta * t)
        return decay * math.cos(d * t), decay * math.sin(d * t) / d
    decay = math.exp(-t / (zeta + d))
    o = -0.5 * decay * math.expm1(-2.0 * d * t) / d
    return decay - d * o, o


@compiled
def move(plant: Plant, z: float, v: float, t: float) -> Pair:
    """Return distance and slope after a time."""
    c, o = solutions(plant, t)
    zeta = plant[1]
    return (c + zeta * o) * z + o * v, (c - zeta * o) * v - o * z


@compiled
def next_turn(plant: Plant, z: float, v: float) -> float:
    """Return the first later time at which the slope is 0, infinite for none."""
    kind, zeta, d = plant
    if kind == LAG:
        return math.inf
    if kind == UNDERDAMPED:
        angle = math.atan2(d * v, zeta * v + z)
        return (angle if angle > 0.0 else angle + math.pi) / d
    part, whole = d * v, zeta * v + z  # their quotient is tanh(d t)
    if not 0.0 < abs(part) < abs(whole) or (part > 0.0) != (whole > 0.0):
        return math.inf
    return 0.5 * math.log1p(2.0 * part / (whole - part)) / d


@compiled
def turn_spacing(plant: Plant) -> float:
    """Return the time from one turning point to the next."""
    return math.pi / plant[2] if plant[0] == UNDERDAMPED else math.inf


@compiled
def steepest(plant: Plant, z: float, v: float, low: float, high: float, turn: float) -> float:
    """Return where a monotone piece that ends at `turn` is steepest within `low` to `high`.

    That is at its inflection point, or at the end next to it. Newton's method converges from there to any level of the
    piece, since on each side the curve bends one way.
    """
    inflection = next_turn(plant, v, -2.0 * plant[1] * v - z)
    if plant[0] == UNDERDAMPED:
        spacing = turn_spacing(plant)
        inflection += spacing * math.floor((turn - inflection) / spacing)
    elif inflection > turn or inflection == math.inf:
        inflection = low
    return min(max(inflection, low), high)


@compiled
def passage(plant: Plant, z: float, v: float, to: float, way: float, low: float, high: float, turn: float) -> float:
    """Return when a monotone piece passes `to` in the direction `way`, by Halley's method in a bracket."""
    if plant[0] == LAG:
        return max(math.log(z / to), low)
    zeta = plant[1]
    t = steepest(plant, z, v, low, high, turn)
    for _ in range(MOST_STEPS):
        distance, slope = move(plant, z, v, t)
        if way * (distance - to) > 0.0:
            high = t
        else:
            low = t
        step = math.inf
        if slope != 0.0:
            newton, bend = (distance - to) / slope, -(2.0 * zeta + distance / slope)
            step = newton / max(1.0 - 0.5 * newton * bend, 0.5)
        if not low <= t - step <= high:
            step = t - (0.5 * (low + high) if high < math.inf else 2.0 * low + 1.0)
        t -= step
        if abs(step) * (1.0 + 2.0 * zeta) < STEP_TOLERANCE:
            break
    return t


@compiled
def exact_switches(plant: Plant, D: float, ends: Pair, thresholds: Pair, way: float, times: Numbers) -> int:
    """Fill in the times of a relay's switches, the first of `times` being its start; return how many there are.

    `ends` is where the PV is heading at the relay's first level and at the other; `thresholds` is where these end, the
    first of them in the direction `way`. An arrival of the relay's output at the plant begins a span of constant input,
    a turning point a monotone piece of it.
    """
    times[0] = 0.0
    count, arrived, begin = 0, 1, D
    level, z, v = ends[0], -ends[0], 0.0
    spacing = turn_spacing(plant)
    while True:
        start, at_start, turn = 0.0, z, next_turn(plant, z, v)
        while True:
            span = times[arrived] + D - begin if arrived <= count else math.inf
            end = min(turn, span)
            at_end = move(plant, z, v, end)[0] if end < math.inf else 0.0
            to = thresholds[count % 2] - level
            if way * (at_end - to) > 0.0:
                count += 1
                if way * (at_start - to) < 0.0:
                    start = passage(plant, z, v, to, way, start, end, turn)
                times[count] = begin + start
                if count == times.size - 1:
                    return count
                way = -way  # the rest of the piece leads away from the next threshold
                span = times[arrived] + D - begin
                end = min(turn, span)
            elif span == math.inf and way * at_end >= 0.0:
                return count  # later turning points are nearer to the level
            if span <= turn:
                break
            start, at_start, turn = end, at_end, turn + spacing
        z, v = move(plant, z, v, span)
        z += level - ends[arrived % 2]
        level, begin = ends[arrived % 2], times[arrived] + D
        arrived += 1


@compiled
def sampled_switches(
    plant: Plant,
    D: float,
    ends: Pair,
    thresholds: Pair,
    way: float,
    noise: Numbers,
    scale: float,
    first: int,
    step: float,
    samples: Counts,
) -> int:
    """Fill in the samples at which a relay switches that reads the PV with noise; return how many there are.

    The first of `samples` is its start, sample 0. The noise is read cyclically from its element `first` on; the test
    ends after one full cycle. The state is propagated from sample to sample with the same matrix; each arrival
    restarts the propagation from the previous arrival.
    """
    c, o = solutions(plant, step)
    by_z, by_v, slope_by_v = c + plant[1] * o, o, c - plant[1] * o
    samples[0] = 0
    count, arrived, begin = 0, 0, 0.0
    level, z0, v0, z, v = 0.0, 0.0, 0.0, 0.0, 0.0
    arrival, at, to = D, first, thresholds[0]
    for sample in range(1, noise.size):
        z, v = by_z * z + by_v * v, slope_by_v * v - by_v * z
        while arrival <= sample * step:
            z0, v0 = move(plant, z0, v0, arrival - begin)
            z0 += level - ends[arrived % 2]
            level, begin = ends[arrived % 2], arrival
            to = thresholds[count % 2] - level
            arrived += 1
            arrival = samples[arrived] * step + D if arrived <= count else math.inf
            z, v = move(plant, z0, v0, sample * step - begin)
        at = at + 1 if at + 1 < noise.size else 0
        if way * (z + scale * noise[at] - to) > 0.0:
            count += 1
            samples[count] = sample
            if count == samples.size - 1:
                return count
            way = -way
            to = thresholds[count % 2] - level
            if arrived == count:
                arrival = sample * step + D
    return count


@compiled
def course(plant: Plant, D: float, ends: Pair, times: Numbers) -> tuple[float, float, bool]:
    """Return the extremes of the PV, given the start and the switches of a relay.

    The lowest and the highest PV over the last full period, and whether the PV has never turned between a switch and
    its arrival.
    """
    start_s, end_s = times[-3], times[-1]
    lowest, highest, turns_once = math.inf, -math.inf, True
    level, z, v, begin = 0.0, 0.0, 0.0, 0.0
    spacing = turn_spacing(plant)
    for k in range(times.size):
        arrival = times[k] + D
        until = min(arrival, end_s) - begin
        turn = next_turn(plant, z, v) if v != 0.0 else math.inf if z == 0.0 else spacing
        while turn < until:
            turns_once &= turn + begin <= times[k]
            if turn + begin >= start_s:
                pv = level + move(plant, z, v, turn)[0]
                lowest, highest = min(lowest, pv), max(highest, pv)
            turn += spacing
        if begin + until >= start_s:
            for t in (max(start_s - begin, 0.0), until):
                pv = level + move(plant, z, v, t)[0]
                lowest, highest = min(lowest, pv), max(highest, pv)
        if arrival >= end_s:
            break
        z, v = move(plant, z, v, arrival - begin)
        z += level - ends[k % 2]
        level, begin = ends[k % 2], arrival
    return lowest, highest, turns_once


@compiled
def first_position(test: Numbers, reading: float) -> tuple[Pair, Pair, float]:
    """Return `ends`, `thresholds` and `way` of a test: the high level first, unless the reading at rest forbids it."""
    K, _, _, _, low, high, reference, hysteresis = test
    way = 1.0 if K > 0.0 else -1.0
    ends_high, ends_low = reference + way * hysteresis, reference - way * hysteresis
    if way * (reading - ends_high) > 0.0:
        return (K * low, K * high), (ends_low, ends_high), -way
    return (K * high, K * low), (ends_high, ends_low), way


@compiled
def run_exact(tests: Numbers, times_s: Numbers, range_pv: Numbers, turns_once: NDArray[np.bool_]) -> None:
    """Run tests, shape (N, 8); fill in the starts and switches, s, and the results of `course`; NaN for none."""
    for i in range(len(tests)):
        test = tests[i]
        kind, zeta, d, w0 = plant_of(test[1], test[2])
        plant, D = (kind, zeta, d), test[3] * w0
        if D <= 0.0 and test[7] <= 0.0:
            continue  # an ideal relay without dead time switches infinitely often in no time
        ends, thresholds, way = first_position(test, 0.0)
        times = np.empty(times_s.shape[1])
        count = exact_switches(plant, D, ends, thresholds, way, times)
        times_s[i, : count + 1] = times[: count + 1] / w0
        if count == times.size - 1:
            range_pv[i, 0], range_pv[i, 1], turns_once[i] = course(plant, D, ends, times)


@compiled
def run_sampled(
    tests: Numbers,
    noise: Numbers,
    scale: Numbers,
    first: Counts,
    sample_time_s: float,
    samples: Counts,
    range_pv: Numbers,
    turns_once: NDArray[np.bool_],
) -> None:
    """Run tests by samples; fill in the starts and switches, samples, -1 for none, and the results of `course`."""
    for i in range(len(tests)):
        test = tests[i]
        kind, zeta, d, w0 = plant_of(test[1], test[2])
        plant, D, step = (kind, zeta, d), test[3] * w0, sample_time_s * w0
        ends, thresholds, way = first_position(test, scale[i] * noise[first[i]])
        count = sampled_switches(plant, D, ends, thresholds, way, noise, scale[i], first[i], step, samples[i])
        if count == samples.shape[1] - 1:
            range_pv[i, 0], range_pv[i, 1], turns_once[i] = course(plant, D, ends, samples[i] * step)
