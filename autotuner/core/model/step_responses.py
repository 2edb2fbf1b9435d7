"""Unit-gain processes without dead time under a held input: their response, its slope, and their free motion.

    Lag              w' = (u - w)/T
    Pair             m w'' + n w' + w = u                  with zero: also the column w'
    Integrator       w' = u
    LaggedIntegrator T w'' + w' = u
    UnstableLag      w' = (w + u)/T
    EqualLags        T w_i' = w_{i-1} - w_i,  w_0 = u, i = 1 .. n
    PairAndLag       m w'' + n w' + w = u,  T v' = w - v

Between two changes of `u` the deviation `z` from the equilibrium moves by `e^{A h}`, and each change shifts it by the
step; samples are read off the last change before them, so any sampling is exact. For a pair of poles `p1 >= p2`, with
`s = (p1 + p2)/2`,

    e^{A h} = c I + o (A - s I),   o = (e^{p1 h} - e^{p2 h})/(p1 - p2),   c = (e^{p1 h} + e^{p2 h})/2

(Moler and Van Loan, SIAM Review 45, 2003), written with `expm1` so that equal poles lose no digits, and with sine and
cosine for a complex pair.

The unstable lag is run backward from the end of the recording, in which direction it is stable; its state at the end
is then one more unknown, which takes the place of the initial state.

Times s, `m` s^2. Every method takes times as arrays of any shape and returns columns of that shape, with inputs that
change at the same times one column each, shape (K, N).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from autotuner.core.model.zoh_input import accumulate, accumulate_states

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.zoh_input import HeldInput

Columns = tuple["FloatArray", ...]


class Motion(Protocol):
    """Interface of a unit-gain process."""

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response columns at the times `when` (dead time already taken off), and their slopes, 1/s."""

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the motions from an initial state, at times since the start of the recording, s."""


@dataclass(frozen=True, slots=True)
class Lag:
    """A stable first-order lag; with `zero` the slope of the response is a column of its own."""

    T: float
    zero: bool = False

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response and its slope."""
        between = held.spans_s
        off = accumulate(np.exp(-between / self.T), -held.steps)
        index, since = held.locate(when)
        fading = off[..., index] * np.exp(-since / self.T)
        response, slope = held.levels[..., index] + fading, -fading / self.T
        return ((response, slope), (slope, -slope / self.T)) if self.zero else ((response,), (slope,))

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the decay of an initial state."""
        return (np.exp(-elapsed / self.T),)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two poles, real or complex; with `zero` the slope of the response is a column of its own."""

    m: float
    n: float
    zero: bool = False

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response (and its slope), and their slopes."""
        between = held.spans_s
        p00, p01, p10, p11 = self.transition(between)
        shifts = np.zeros((*held.levels.shape, 2))
        shifts[..., 0] = -held.steps
        off = accumulate_states(((p00, p01), (p10, p11)), shifts)
        index, since = held.locate(when)
        p00, p01, p10, p11 = self.transition(since)
        z, slope = off[..., index, 0], off[..., index, 1]
        z, slope = p00 * z + p01 * slope, p10 * z + p11 * slope
        response = held.levels[..., index] + z
        if not self.zero:
            return (response,), (slope,)
        return (response, slope), (slope, -(z + self.n * slope) / self.m)

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the motions from an initial deviation and from an initial slope."""
        p00, p01, _, _ = self.transition(elapsed)
        return p00, p01 / math.sqrt(self.m)

    def transition(self, h: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the entries of `e^{A h}` for the state (deviation, slope)."""
        s = -self.n / (2.0 * self.m)
        discriminant = s * s - 1.0 / self.m
        even, odd = _real_poles(s, discriminant, self.m, h) if discriminant >= 0.0 else _complex(s, discriminant, h)
        return even - s * odd, odd, -odd / self.m, even + s * odd


def _real_poles(s: float, discriminant: float, m: float, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    fast = s - math.sqrt(discriminant)
    slow = 1.0 / (m * fast)
    apart = slow - fast
    decay = np.exp(slow * h)
    odd = decay * h if apart == 0.0 else -decay * np.expm1(-apart * h) / apart
    return decay - 0.5 * apart * odd, odd


def _complex(s: float, discriminant: float, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    turn = math.sqrt(-discriminant)
    decay = np.exp(s * h)
    return decay * np.cos(turn * h), decay * np.sin(turn * h) / turn


@dataclass(frozen=True, slots=True)
class EqualLags:
    """Lags of the same time constant in series.

    Their deviations `d_i` from the equilibrium move by the terms of Erlang's distribution (`x = h/T`),

        d_i(h) = sum_{j <= i} e^{-x} x^{i-j}/(i-j)! d_j
    """

    T: float
    n: int

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response and its slope."""
        terms = self._terms(held.spans_s)
        P = np.zeros((self.n, self.n, held.times.size))
        for row, column in itertools.combinations_with_replacement(range(self.n), 2):
            P[column, row] = terms[column - row]
        off = accumulate_states(P, np.repeat(-held.steps[..., None], self.n, axis=-1))
        index, since = held.locate(when)
        terms = self._terms(since)
        last = np.sum([terms[k] * off[..., index, self.n - 1 - k] for k in range(self.n)], axis=0)
        before = np.sum([terms[k] * off[..., index, self.n - 2 - k] for k in range(self.n - 1)], axis=0)
        return (held.levels[..., index] + last,), ((before - last) / self.T,)

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the motions of the last lag from an initial deviation of each."""
        return tuple(self._terms(elapsed))

    def _terms(self, h: FloatArray) -> list[FloatArray]:
        x = h / self.T
        terms = [np.exp(-x)]
        for k in range(1, self.n):
            terms.append(terms[-1] * x / k)
        return terms


TOO_NEAR, APART = 1e-8, 3e-4
"""`m l^2 + n l + 1` at `l = -1/T` under which a lag is taken to be one of the pair, and the shift, relative, that it is
then given: rounding of 1e-16 over the first is under 1e-8 of the response, and so is the square of the second."""


@dataclass(frozen=True, slots=True)
class PairAndLag:
    """Two poles, real or complex, and a lag in series.

    With `A` of the pair and `l = -1/T`, the lag's answer to the pair's state is

        e_1' (e^{A h} - e^{l h} I) (T A + I)^-1
    """

    m: float
    n: float
    T: float

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response and its slope."""
        P = self._transition(held.spans_s)
        off = accumulate_states((P[:3], P[3:6], P[6:]), np.multiply.outer(held.steps, (-1.0, 0.0, -1.0)))
        index, since = held.locate(when)
        p00, p01, _, _, _, _, q0, q1, q2 = self._transition(since)
        z, slope, lagged = (off[..., index, k] for k in range(3))
        answer = q0 * z + q1 * slope + q2 * lagged
        return (held.levels[..., index] + answer,), ((p00 * z + p01 * slope - answer) / self.T,)

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the motions from an initial deviation and slope of the pair, and of the lag."""
        q0, q1, q2 = self._transition(elapsed)[6:]
        return q0, q1 / math.sqrt(self.m), q2

    def _transition(self, h: FloatArray) -> tuple[FloatArray, ...]:
        """Return the entries of `e^{A h}` for the state (deviation, slope, deviation of the lag), row by row."""
        pole, determinant = self._pole_of_the_lag()
        p00, p01, p10, p11 = Pair(self.m, self.n).transition(h)
        fading, zero = np.exp(pole * h), np.zeros_like(h)
        first, second = (p00 - fading) / determinant, p01 / determinant
        inverse = (self.m - self.n / -pole, -self.m / -pole, 1.0 / -pole, self.m)
        q0 = first * inverse[0] + second * inverse[2]
        q1 = first * inverse[1] + second * inverse[3]
        return p00, p01, zero, p10, p11, zero, q0, q1, fading

    def _pole_of_the_lag(self) -> tuple[float, float]:
        """Return `-1/T` and `m det(T A + I)`, with the lag moved off a pole of the pair."""
        T = self.T
        value = self.m - self.n * T + T * T
        if abs(value) < TOO_NEAR * T * T:
            T *= 1.0 + APART
            value = self.m - self.n * T + T * T
        return -1.0 / T, value


@dataclass(frozen=True, slots=True)
class Integrator:
    """A pure integrator."""

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the integral of the input, and the input."""
        reached = _reached(held.levels[..., :-1] * held.spans_s[1:])
        index, since = held.locate(when)
        level = held.levels[..., index]
        return (reached[..., index] + level * since,), (level,)

    def free(self, elapsed: FloatArray) -> Columns:  # noqa: ARG002 - the protocol's signature
        """Return nothing: its state is the offset."""
        return ()


def _reached(covered: FloatArray) -> FloatArray:
    """Return what an integrator has reached at each change: 0, then the sums of what it covered between them."""
    return np.concatenate((np.zeros((*covered.shape[:-1], 1)), np.cumsum(covered, axis=-1)), axis=-1)


@dataclass(frozen=True, slots=True)
class LaggedIntegrator:
    """An integrator in series with a lag."""

    T: float

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response and its slope."""
        between = held.spans_s
        off = accumulate(np.exp(-between / self.T), -held.steps)
        ahead = between[1:]
        reached = _reached(held.levels[..., :-1] * ahead - self.T * off[..., :-1] * np.expm1(-ahead / self.T))
        index, since = held.locate(when)
        slope_off = off[..., index]
        fading = np.expm1(-since / self.T)
        level = held.levels[..., index]
        response = reached[..., index] + level * since - self.T * slope_off * fading
        return (response,), (level + slope_off * (fading + 1.0),)

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the coming to rest of an initial slope."""
        return (np.exp(-elapsed / self.T),)


@dataclass(frozen=True, slots=True)
class UnstableLag:
    """An unstable first-order lag, run backward from `end_s`, the end of the recording."""

    T: float
    end_s: float

    def forced(self, held: HeldInput, when: FloatArray) -> tuple[Columns, Columns]:
        """Return the response that ends in equilibrium with the last input, and its slope."""
        after = np.append(held.times[1:], np.inf)
        back = accumulate(np.exp(-(after - held.times)[::-1] / self.T), -held.steps[..., ::-1])[..., ::-1]
        index = np.searchsorted(held.times, when, side="right")
        ahead = np.append(held.times, np.inf)[index] - when
        none = np.zeros((*back.shape[:-1], 1))
        off = np.concatenate((back, none), axis=-1)[..., index] * np.exp(-ahead / self.T)
        return (off - np.concatenate((none, held.levels), axis=-1)[..., index],), (off / self.T,)

    def free(self, elapsed: FloatArray) -> Columns:
        """Return the motion that ends in a state away from equilibrium."""
        return (np.exp((elapsed - self.end_s) / self.T),)
