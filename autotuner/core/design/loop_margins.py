"""Robustness of a loop: sensitivities, margins, stability, noise gain.

    L = C F G,  S = 1/(1 + L),  T = L/(1 + L),  R = C F/(1 + L)
    Ms = max |S|,  Mt = max |T|,  noise gain = max |R|

on the exact frequency response, dead time and measurement filter included; no Pade.
Frequencies rad/s, `Ms`, `Mt` and gain margins dimensionless, phase margin deg, delay margin s, noise gain output/PV.

Invariants: every figure is refined from the grid to the precision of its definition; a figure of an unstable
loop is None, never a number that looks like one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.design.gains import controller_response
from autotuner.core.design.nyquist import controller_tail, encircles_nothing, frequency_grid, path_ends, resolved
from autotuner.core.model.process import frequency_response

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.arrays import ComplexArray, FloatArray, IntArray
    from autotuner.core.model.process import ProcessModel


@dataclass(frozen=True, slots=True)
class Margins:
    """Robustness of a loop; all but `stable` are None when it is unstable.

    Attributes
    ----------
    stable : bool
        Whether the closed loop is stable.
    Ms, Mt : float or None
        Largest sensitivity and complementary sensitivity.
    gain_margin : float or None
        Factor by which the loop gain may grow; infinite when any.
    gain_reduction_margin : float or None
        Factor down to which the loop gain may shrink; 0 when any. Above 0 for unstable processes.
    phase_margin_deg : float or None
        Phase that may be lost, deg; infinite when the loop gain never reaches 1.
    delay_margin_s : float or None
        Dead time that may be added, s; infinite when the loop gain never reaches 1.
    noise_gain : float or None
        Largest gain from measurement noise to output, output/PV.
    """

    stable: bool
    Ms: float | None = None
    Mt: float | None = None
    gain_margin: float | None = None
    gain_reduction_margin: float | None = None
    phase_margin_deg: float | None = None
    delay_margin_s: float | None = None
    noise_gain: float | None = None

    def to_dict(self) -> dict[str, float | bool | None]:
        """Return JSON-ready values; infinite or undefined values are null."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: value if value is not None and math.isfinite(value) else None for name, value in values.items()}


UNSTABLE = Margins(stable=False)
PEAKS, PEAK_ROUNDS, PEAK_POINTS = 3, 4, 17
"""Peaks of a sensitivity that are refined, and how: 17 points between its neighbours, 4 times, which is to 1/4096."""


def margins(model: ProcessModel, gains: PidGains) -> Margins:
    """Return the robustness of a process under a controller."""

    def loop(w: FloatArray) -> ComplexArray:
        return controller_response(gains, w) * frequency_response(model, w)

    w, L = resolved(loop, frequency_grid(model, gains))
    ends = path_ends(model, gains)
    if not encircles_nothing(ends, L):
        return UNSTABLE
    circle = [(x, float(np.angle(-loop(np.array([x])))[0])) for x in _unit_circle(loop, w, L)]
    axis = [*_negative_axis(loop, w, L), *ends.start_on_negative_axis]
    nearest = 1.0 - abs(ends.tail) if ends.delayed else abs(1.0 + ends.tail)
    S, T, R = _peaks(model, gains, w, L)
    return Margins(
        stable=True,
        Ms=max(S, 1.0 / nearest),
        Mt=max(T, abs(ends.tail) / nearest, ends.Mt_at_rest),
        gain_margin=min((1.0 / a for a in axis if a < 1.0), default=math.inf),
        gain_reduction_margin=max((1.0 / a for a in axis if a > 1.0), default=0.0),
        phase_margin_deg=min((abs(math.degrees(p)) for _, p in circle), default=math.inf),
        delay_margin_s=min(((p % (2.0 * math.pi)) / x for x, p in circle), default=math.inf),
        noise_gain=max(R, controller_tail(gains) / nearest, ends.noise_gain_at_rest),
    )


def is_stable(model: ProcessModel, gains: PidGains) -> bool:
    """Return whether the closed loop is stable."""
    _, L = resolved(
        lambda w: controller_response(gains, w) * frequency_response(model, w), frequency_grid(model, gains)
    )
    return encircles_nothing(path_ends(model, gains), L)


def _peaks(model: ProcessModel, gains: PidGains, w: FloatArray, L: ComplexArray) -> list[float]:
    """Return the largest `|S|`, `|T|`, `|R|`, refined between the neighbours of the three highest peaks of each."""

    def sizes(C: ComplexArray, L: ComplexArray) -> FloatArray:
        return np.abs(np.stack((np.ones_like(L), L, C)) / (1.0 + L))

    size = sizes(controller_response(gains, w), L)
    highest = np.max(size, axis=1)
    peaks = [_highest(one) for one in size]
    which, at = np.repeat(np.arange(len(peaks)), [peak.size for peak in peaks]), np.concatenate(peaks)
    low, high, rows = w[at - 1], w[at + 1], np.arange(at.size)
    for _ in range(PEAK_ROUNDS if at.size else 0):
        fine = np.linspace(low, high, PEAK_POINTS, axis=1)
        C = controller_response(gains, fine)
        fine_size = sizes(C, C * frequency_response(model, fine))[which, rows]
        k = np.clip(np.argmax(fine_size, axis=1), 1, PEAK_POINTS - 2)
        low, high = fine[rows, k - 1], fine[rows, k + 1]
        np.maximum.at(highest, which, np.max(fine_size, axis=1))
    return [float(peak) for peak in highest]


def _highest(size: FloatArray) -> IntArray:
    """Return where the three highest inner peaks are."""
    inner = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])) + 1
    highest: IntArray = inner[np.argsort(size[inner])[-PEAKS:]]
    return highest


def _unit_circle(loop: Callable[[FloatArray], ComplexArray], w: FloatArray, L: ComplexArray) -> list[float]:
    """Return the frequencies at which the loop gain is 1."""

    def excess(x: float) -> float:
        return math.log(abs(complex(loop(np.array([x]))[0])))

    return [_root(excess, w, int(i)) for i in np.flatnonzero(np.diff(np.abs(L) > 1.0))]


def _negative_axis(loop: Callable[[FloatArray], ComplexArray], w: FloatArray, L: ComplexArray) -> list[float]:
    """Return `-L` where `L` crosses the negative real axis next to -1: the two nearest outside and inside."""

    def imaginary(x: float) -> float:
        return float(loop(np.array([x]))[0].imag)

    crossed = np.flatnonzero(np.diff(L.imag > 0.0) & (L.real[:-1] < 0.0) & (L.real[1:] < 0.0))
    size = -L.real[crossed]
    ranked = crossed[np.argsort(np.abs(np.log(size)))]
    outside, inside = (ranked[(-L.real[ranked] > 1.0) == side][:2] for side in (True, False))
    return [-float(loop(np.array([_root(imaginary, w, int(i))]))[0].real) for i in (*outside, *inside)]


def _root(function: Callable[[float], float], w: FloatArray, i: int) -> float:
    """Return the root between two neighbours of the grid; one of them when it is the root to rounding."""
    low, high = float(w[i]), float(w[i + 1])
    at_low, at_high = function(low), function(high)
    if at_low * at_high >= 0.0:
        return low if abs(at_low) < abs(at_high) else high
    return float(scipy.optimize.brentq(function, low, high, xtol=1e-14 * low, rtol=1e-13))
