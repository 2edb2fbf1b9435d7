"""Detects a sustained oscillation of a signal by the regularity of the zero crossings of its autocorrelation.

    r(l)       = N/(N-l) sum e(k) e(k+l) / sum e(k)^2  autocorrelation of the error e about its own straight line
    Tp         = 2 mean(d),  R = mean(d) / (3 std(d))  d: distances of its zero crossings, s
    oscillates where R > 1 over the first crossings, and r(Tp) is far from zero
    A          = sqrt(2 r(Tp) mean(e^2))               the part correlated over a period is the oscillation

`e`, `A` PV units, `Tp`, `d` s. (N. F. Thornhill, B. Huang, H. Zhang, Detection of multiple oscillations in control
loops, Journal of Process Control 13, 2003: noise has no regular crossings, a response to a step has too few.)
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray

FEWEST, CROSSINGS = 7, 11
"""Required zero crossings, three periods, and used zero crossings, five."""
REGULAR = 1.0
"""Regularity of the zero crossings above which a loop oscillates (Thornhill et al., J. Process Control 13, 2003)."""
LONGEST_LAG = 0.6
"""Largest lag of the autocorrelation, as a share of the signal's length."""
REPEATS = 0.3
"""Autocorrelation after one period from which it is one."""


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A regular oscillation.

    Attributes
    ----------
    period_s, amplitude : float
        In s and PV units.
    regularity : float
        `R` above: over 1.
    """

    period_s: float
    amplitude: float
    regularity: float

    def to_dict(self) -> dict[str, float]:
        """Return JSON-ready values."""
        return asdict(self)


def oscillation_of(t: FloatArray, error: FloatArray) -> Oscillation | None:
    """Return the oscillation of a signal; None where it has none.

    Parameters
    ----------
    t : array of float, shape (N,)
        Times, s, increasing.
    error : array of float, shape (N,)
        Control error, or the PV itself, PV units.
    """
    interval_s = float(np.median(np.diff(t)))
    at = np.arange(t[0], t[-1], interval_s)
    if at.size < 4 * FEWEST:
        return None
    e = scipy.signal.detrend(np.interp(at, t, error))
    power = float(e @ e)
    if power <= 0.0:
        return None
    r = scipy.signal.correlate(e, e, method="fft")[e.size - 1 :] / power
    crossings = _crossings(r[: int(LONGEST_LAG * e.size)])[:CROSSINGS]
    if crossings.size < FEWEST:
        return None
    between = np.diff(crossings)
    period, scatter = 2.0 * float(np.mean(between)), float(np.std(between))
    regularity = math.inf if scatter == 0.0 else period / (6.0 * scatter)
    repeats = float(np.interp(period, np.arange(r.size), r)) * e.size / (e.size - period)
    if regularity <= REGULAR or repeats < REPEATS:
        return None
    return Oscillation(period * interval_s, math.sqrt(2.0 * repeats * power / e.size), regularity)


def _crossings(r: FloatArray) -> FloatArray:
    """Return where a sequence crosses zero, in its steps."""
    k = np.flatnonzero(np.signbit(r[1:]) != np.signbit(r[:-1]))
    crossings: FloatArray = k + r[k] / (r[k] - r[k + 1])
    return crossings
