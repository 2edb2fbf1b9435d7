"""The process from its limit cycle, exactly: no describing-function bias for any structure.

The fundamentals of relay and PV determine the size of the response at the cycle's frequency `w`, and the peak
determines the remaining shape, because it depends on the harmonics too:

    |G(jw)| = A1/U1                             w = 2 pi/Pu
    first order    T = sqrt(r^2 - 1)/w,  D = (lag - atan(w T))/w: every sample counts for the two fundamentals
    second order   1 - m w^2 = r cos psi,  n w = r sin psi,  r = K U1/A1;  psi by the peak
    integrating    T by the ratio of peak to fundamental, then K by the fundamental
    unstable       (w T)^2 = r^2 - 1

The dead time follows from the wave: the input turns one dead time after the relay, which switched at a known PV,

    y(t_h - D) = PV at which the output fell,   y(t_h + t_l - D) = PV at which it rose.

`A` peak, `A1`, `U1` fundamentals of PV and relay, `t_h`, `t_l` half periods (s). State-space equations of the cycle:
Majhi and Atherton, IEE Proc. Control Theory Appl. 146 (1999); Astrom (1995). Two second-order processes may share all
of these; the phase by which the PV's fundamental lags, `psi + w D`, distinguishes them where it is known.

Invariants: gains are positive here, a process of negative gain is mirrored by the caller; a cycle that no
process of the structure can have raises `InputError`.

The steady oscillation of a process without its dead time, exactly.

With the input high (`u = high`) for `t_h` and low for `t_l`, periodically, the deviation from the equilibrium moves by
`e^{A t}`, and each switch shifts it by the step of the equilibrium; periodicity determines it:

    z_l = e^{A t_h} z_h + s,   z_h = e^{A t_l} z_l - s

(Astrom, Oscillations in systems with relay feedback, 1995.) `t = 0` is the time at which the INPUT turns high; the
relay itself leads it by the dead time. Levels are deviations from the output whose equilibrium is PV 0; for an
integrating process from the mean output. Times s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.model.process import Fopdt, Integrating, UnstableFopdt, second_order
from autotuner.core.model.step_responses import Pair
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import SopdtOverdamped, SopdtUnderdamped
    from autotuner.core.signals.limit_cycle import LimitCycle

ANGLES = 60
"""Values of psi that are tried for the peak."""
SHORTEST, LONGEST = 1e-4, 1e3
"""Lag of an integrating process searched for, in periods."""
SAME_DEAD_TIME = 0.05
"""Difference of the dead times from the two switches, in periods, up to which they are the same crossing."""


def fopdt_of_response(K: float, cycle: LimitCycle) -> Fopdt:
    """Return the first-order process of static gain `K` whose response at the period is that of the cycle.

    Raises
    ------
    InputError
        The fundamental reaches `|K| U1`, or the cycle has no dead time in it.
    """
    ratio, w = abs(K) * cycle.relay_fundamental / cycle.A1, 2.0 * math.pi / cycle.Pu
    if not ratio > 1.0:
        raise too_large(K, cycle.A1, cycle.relay_fundamental)
    turn = math.sqrt((ratio - 1.0) * (ratio + 1.0))
    lag = (cycle.lag_rad - (math.pi if K < 0.0 else 0.0)) % (2.0 * math.pi)
    return with_dead_time(K, turn / w, (lag - math.atan(turn)) / w)


def sopdt_of_cycle(K: float, cycle: LimitCycle) -> SopdtOverdamped | SopdtUnderdamped:
    """Return the second-order process of static gain `K` that oscillates as `cycle`.

    Raises
    ------
    InputError
        None does.
    """
    cycle = _mirrored(cycle) if K < 0.0 else cycle
    r, w = abs(K) * cycle.relay_fundamental / cycle.A1, 2.0 * math.pi / cycle.Pu

    def shape(psi: float) -> tuple[float, float]:
        return (1.0 - r * math.cos(psi)) / w**2, r * math.sin(psi) / w

    def wave_of(psi: float) -> Wave:
        return second_order_wave(abs(K), *shape(psi), *_input(cycle))

    def excess(psi: float) -> float:
        return _half_swing(wave_of(psi).extremes()) - cycle.A

    first = math.acos(1.0 / r) if r > 1.0 else 0.0
    angles = first + (math.pi - first) * (np.arange(ANGLES) + 0.5) / ANGLES
    found = []
    for low, high in _brackets(excess, angles.tolist()):
        psi = float(scipy.optimize.brentq(excess, low, high, xtol=1e-15, rtol=1e-15))
        found += [
            (miss + _phase_miss(psi + w * D, cycle), second_order(K, *shape(psi), D))
            for miss, D in _dead_times(wave_of(psi), cycle)
        ]
    if not found:
        raise _none("a second-order process")
    return min(found, key=lambda pair: pair[0])[1]


def integrating_of_cycle(cycle: LimitCycle, sign: float = 1.0) -> Integrating:
    """Return the integrating process that oscillates as `cycle`; `sign` is that of its gain.

    Raises
    ------
    InputError
        None does.
    """
    cycle = _mirrored(cycle) if sign < 0.0 else cycle
    w = 2.0 * math.pi / cycle.Pu

    def gain(T: float) -> float:
        return cycle.A1 / cycle.relay_fundamental * w * math.hypot(1.0, w * T)

    def excess(log_T: float) -> float:
        T = math.exp(log_T)
        return _half_swing(integrating_wave(gain(T), T, *_input(cycle)).extremes()) - cycle.A

    shortest, longest = math.log(SHORTEST * cycle.Pu), math.log(LONGEST * cycle.Pu)
    T = 0.0
    if excess(shortest) > 0.0:
        if excess(longest) > 0.0:
            raise _none("an integrator")
        T = math.exp(scipy.optimize.brentq(excess, shortest, longest, xtol=1e-15, rtol=1e-15))
    found = _dead_times(integrating_wave(gain(T), T, *_input(cycle)), cycle)
    if not found:
        raise _none("an integrator")
    return Integrating(math.copysign(gain(T), sign), T, min(found)[1])


def unstable_of_cycle(K: float, cycle: LimitCycle) -> UnstableFopdt:
    """Return the unstable first-order process of gain `K` that oscillates as `cycle`.

    Raises
    ------
    InputError
        None does.
    """
    cycle = _mirrored(cycle) if K < 0.0 else cycle
    r, w = abs(K) * cycle.relay_fundamental / cycle.A1, 2.0 * math.pi / cycle.Pu
    if not r > 1.0:
        raise _none("an unstable lag")
    T = math.sqrt((r - 1.0) * (r + 1.0)) / w
    found = _dead_times(first_order_wave(-abs(K), -1.0 / T, *_input(cycle)), cycle)
    if not found:
        raise _none("an unstable lag")
    return UnstableFopdt(K, T, min(found)[1])


def with_dead_time(K: float, T: float, D: float) -> Fopdt:
    """Return the process; raises `InputError` for a negative dead time."""
    if D < 0.0:
        raise InputError(
            f"turns {-D:g} s before the relay switches",
            field="limit_cycle",
            value=D,
            remedy="Sample faster, or use least squares.",
        )
    return Fopdt(K, T, D)


def too_large(K: float, A: float, h: float) -> InputError:
    """Return the error for an amplitude `A` that no first-order process of gain `K` reaches with a swing `h`."""
    return InputError(
        f"times h = {h:g} does not exceed the amplitude {A:g}: a first-order process of this gain stays below it",
        field="K",
        value=K,
        remedy="Check the static gain; an underdamped process needs another structure.",
    )


def _dead_times(wave: Wave, cycle: LimitCycle) -> list[tuple[float, float]]:
    """Return possible dead times, each after the disagreement of the two switches on it, in periods."""
    shift = cycle.highest - wave.extremes()[1]
    falls = [(cycle.high_s - t) % cycle.Pu for t in wave.crossings(cycle.pv_at_fall - shift, 1)]
    rises = [(cycle.Pu - t) % cycle.Pu for t in wave.crossings(cycle.pv_at_rise - shift, -1)]
    pairs = [(_apart(fall, rise, cycle.Pu), fall, rise) for fall in falls for rise in rises]
    return [
        (apart, fall + _signed(rise - fall, cycle.Pu) / 2.0) for apart, fall, rise in pairs if apart <= SAME_DEAD_TIME
    ]


def _brackets(excess: Callable[[float], float], angles: list[float]) -> list[tuple[float, float]]:
    """Return intervals with one root each; two roots within a step of the grid show as a turn towards zero."""
    values = [excess(psi) for psi in angles]
    found = [(a, b) for (a, one), (b, other) in pairwise(zip(angles, values, strict=True)) if one * other <= 0.0]
    for k in range(1, len(angles) - 1):
        before, here, after = (value * math.copysign(1.0, values[k]) for value in values[k - 1 : k + 2])
        if before > here <= after:
            turn = scipy.optimize.minimize_scalar(
                lambda psi, k=k: excess(psi) * values[k], (angles[k - 1], angles[k], angles[k + 1])
            ).x
            if excess(turn) * values[k] < 0.0:
                found += [(angles[k - 1], turn), (turn, angles[k + 1])]
    return found


def _phase_miss(lag: float, cycle: LimitCycle) -> float:
    """Return by how much the lag of the fundamental is missed, in periods; 0 where it was not measured."""
    return 0.0 if math.isnan(cycle.lag_rad) else _apart(lag, cycle.lag_rad, 2.0 * math.pi)


def _half_swing(extremes: tuple[float, float]) -> float:
    return (extremes[1] - extremes[0]) / 2.0


def _apart(one: float, other: float, Pu: float) -> float:
    return abs(_signed(other - one, Pu)) / Pu


def _signed(difference: float, Pu: float) -> float:
    return (difference + Pu / 2.0) % Pu - Pu / 2.0


def _mirrored(cycle: LimitCycle) -> LimitCycle:
    """Return the cycle of the process of opposite gain: the PV turned upside down."""
    return replace(
        cycle,
        lowest=-cycle.highest,
        highest=-cycle.lowest,
        pv_at_rise=-cycle.pv_at_rise,
        pv_at_fall=-cycle.pv_at_fall,
        lag_rad=cycle.lag_rad - math.pi,
    )


def _input(cycle: LimitCycle) -> tuple[tuple[float, float], tuple[float, float]]:
    return (cycle.bias - cycle.h, cycle.bias + cycle.h), (cycle.high_s, cycle.low_s)


def _none(what: str) -> InputError:
    return InputError(
        f"is not that of {what}",
        field="limit_cycle",
        remedy="Check the static gain, or leave the structure to least squares.",
    )


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
