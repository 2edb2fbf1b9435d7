"""The steady oscillation of a process without its dead time, exactly.

With the input high (`u = high`) for `t_h` and low for `t_l`, over and over, the deviation from the equilibrium moves by
`e^{A t}`, and each switch shifts it by the step of the equilibrium; periodicity fixes it:

    z_l = e^{A t_h} z_h + s,   z_h = e^{A t_l} z_l - s

(Astrom, Oscillations in systems with relay feedback, 1995.) `t = 0` is the moment at which the INPUT turns high; the
relay itself is ahead of it by the dead time. Levels are deviations from the output whose equilibrium is PV 0; for an
integrating process from the mean output. Times s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.identification.motions import Pair

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import FloatArray

GRID = 200
"""Points a half period is searched at for turning points and crossings, before they are refined."""

Curve = tuple["FloatArray", "FloatArray"]


@dataclass(frozen=True, slots=True)
class Wave:
    """One period.

    Attributes
    ----------
    high_s, low_s : float
        Time of the input at each level, s.
    high, low : callable
        Value and slope, at times since the input turned high, and low.
    """

    high_s: float
    low_s: float
    high: Callable[[FloatArray], Curve]
    low: Callable[[FloatArray], Curve]

    def at(self, t: float) -> tuple[float, float]:
        """Return value and slope at a time since the input turned high, s; periodic."""
        phase = t % (self.high_s + self.low_s)
        value, slope = (
            self.high(np.array([phase])) if phase < self.high_s else self.low(np.array([phase - self.high_s]))
        )
        return float(value[0]), float(slope[0])

    def extremes(self) -> tuple[float, float]:
        """Return the lowest and the highest value."""
        turns = [self.at(t)[0] for t in (0.0, self.high_s)]
        turns += [self.high(np.array([t]))[0][0] for t in _roots(self.high, self.high_s, 1, 0.0)]
        turns += [self.low(np.array([t]))[0][0] for t in _roots(self.low, self.low_s, 1, 0.0)]
        return float(min(turns)), float(max(turns))

    def crossings(self, level: float, direction: int) -> list[float]:
        """Return the times at which the wave passes a level upward (1) or downward (-1), s."""
        found = _roots(self.high, self.high_s, 0, level)
        found += [self.high_s + t for t in _roots(self.low, self.low_s, 0, level)]
        return [t for t in found if self.at(t)[1] * direction >= 0.0]


def _roots(curve: Callable[[FloatArray], Curve], span: float, which: int, level: float) -> list[float]:
    """Return where the value (0) or the slope (1) of a curve passes a level, s."""

    def above(t: float) -> float:
        return float(curve(np.array([t]))[which][0]) - level

    t = np.linspace(0.0, span, GRID)
    values = curve(t)[which] - level
    exact: list[float] = t[values == 0.0].tolist()
    changes = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    return exact + [float(scipy.optimize.brentq(above, t[k], t[k + 1], xtol=1e-15 * span, rtol=1e-15)) for k in changes]


def second_order_wave(K: float, m: float, n: float, levels: tuple[float, float], spans: tuple[float, float]) -> Wave:
    """Return the wave of `K/(m s^2 + n s + 1)`; levels are (low, high), spans (high_s, low_s)."""
    pair = Pair(m, n)
    (low, high), (high_s, low_s) = levels, spans
    step = np.array([K * (high - low), 0.0])
    over_high, over_low = _matrix(pair, high_s), _matrix(pair, low_s)
    at_high = np.linalg.solve(np.eye(2) - over_low @ over_high, over_low @ step - step)
    at_low = over_high @ at_high + step

    def part(level: float, start: FloatArray) -> Callable[[FloatArray], Curve]:
        def curve(t: FloatArray) -> Curve:
            p00, p01, p10, p11 = pair.transition(t)
            return K * level + p00 * start[0] + p01 * start[1], p10 * start[0] + p11 * start[1]

        return curve

    return Wave(high_s, low_s, part(high, at_high), part(low, at_low))


def first_order_wave(K: float, rate: float, levels: tuple[float, float], spans: tuple[float, float]) -> Wave:
    """Return the wave of `y' = -rate (y - K u)`; an unstable process has a negative rate, 1/s."""
    (low, high), (high_s, low_s) = levels, spans
    step = K * (high - low)
    at_high = step * math.expm1(-rate * low_s) / -math.expm1(-rate * (high_s + low_s))
    at_low = math.exp(-rate * high_s) * at_high + step

    def part(level: float, start: float) -> Callable[[FloatArray], Curve]:
        def curve(t: FloatArray) -> Curve:
            off = start * np.exp(-rate * t)
            return K * level + off, -rate * off

        return curve

    return Wave(high_s, low_s, part(high, at_high), part(low, at_low))


def integrating_wave(K: float, T: float, levels: tuple[float, float], spans: tuple[float, float]) -> Wave:
    """Return the wave of `K/(s (T s + 1))`, 0 when the input turns high; `T` may be 0."""
    (low, high), (high_s, low_s) = levels, spans
    middle = (high * high_s + low * low_s) / (high_s + low_s)
    rate = 1.0 / T if T > 0.0 else math.inf
    slope = first_order_wave(K, rate, (low - middle, high - middle), spans) if T > 0.0 else None

    def part(level: float, begin: float, start: float) -> Callable[[FloatArray], Curve]:
        def curve(t: FloatArray) -> Curve:
            away = level - middle
            if slope is None:
                return begin + K * away * t, np.full(t.shape, K * away)
            off = start - K * away
            fading = np.exp(-rate * t)
            return begin + K * away * t + off * T * (1.0 - fading), K * away + off * fading

        return curve

    at_rise, at_fall = (slope.at(0.0)[0], slope.at(high_s)[0]) if slope is not None else (0.0, 0.0)
    rising = part(high, 0.0, at_rise)
    return Wave(high_s, low_s, rising, part(low, float(rising(np.array([high_s]))[0][0]), at_fall))


def _matrix(pair: Pair, h: float) -> FloatArray:
    p00, p01, p10, p11 = pair.transition(np.array([h]))
    return np.array([[p00[0], p01[0]], [p10[0], p11[0]]])
