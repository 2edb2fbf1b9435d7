"""Robustness of a loop: sensitivities, margins, stability, noise gain.

    L = C F G,  S = 1/(1 + L),  T = L/(1 + L),  R = C F/(1 + L)
    Ms = max |S|,  Mt = max |T|,  noise gain = max |R|

on the exact frequency response, dead time and measurement filter included; no Pade. A loop with process poles `P` right
of the axis and `q` poles at the origin is stable when (Nyquist; the contour leaves the origin to its left)

    P - (1/pi) [arg(1 + L)] from w = 0+ to infinity + q/2 = 0

Frequencies rad/s, `Ms`, `Mt` and gain margins dimensionless, phase margin deg, delay margin s, noise gain output/PV.

Rules of this file: every figure is refined from the grid to the precision of its definition; a figure of an unstable
loop is None, never a number that looks like one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from autotuner.core.process import frequency_response
from autotuner.core.tuning.gains import controller_response

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import ComplexArray, FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.gains import PidGains

POINTS_PER_DECADE = 60
DECADES = 4
"""Beyond the outermost corners."""
WIDEST = 10
"""Decades between corners beyond which the fastest are not followed: a lag of that size is none."""
TURNS = 40
"""Turns of the dead time's phasor that are followed at an even step."""
EVEN_STEP_RAD = 0.1
LARGEST_STEP = 0.3
"""Of the distance from -1, so that a path next to -1 passes it on the right side."""
REFINEMENTS = 48


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
        """Return JSON-ready values; what is infinite or not defined is null."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: value if value is not None and math.isfinite(value) else None for name, value in values.items()}


UNSTABLE = Margins(stable=False)


def margins(model: ProcessModel, gains: PidGains) -> Margins:
    """Return the robustness of a process under a controller."""

    def loop(w: FloatArray) -> ComplexArray:
        return controller_response(gains, w) * frequency_response(model, w)

    w, L = _resolved(loop, frequency_grid(model, gains))
    ends = _ends(model, gains)
    if not _encircles_nothing(ends, L):
        return UNSTABLE
    circle = [(x, float(np.angle(-loop(np.array([x])))[0])) for x in _unit_circle(loop, w, L)]
    axis = [*_negative_axis(loop, w, L), *ends.start_on_negative_axis]
    nearest = 1.0 - abs(ends.tail) if ends.delayed else abs(1.0 + ends.tail)
    return Margins(
        stable=True,
        Ms=max(_peak(lambda x: 1.0 / (1.0 + loop(x)), w), 1.0 / nearest),
        Mt=max(_peak(lambda x: 1.0 - 1.0 / (1.0 + loop(x)), w), abs(ends.tail) / nearest, ends.Mt_at_rest),
        gain_margin=min((1.0 / a for a in axis if a < 1.0), default=math.inf),
        gain_reduction_margin=max((1.0 / a for a in axis if a > 1.0), default=0.0),
        phase_margin_deg=min((abs(math.degrees(p)) for _, p in circle), default=math.inf),
        delay_margin_s=min(((p % (2.0 * math.pi)) / x for x, p in circle), default=math.inf),
        noise_gain=max(
            _peak(lambda x: controller_response(gains, x) / (1.0 + loop(x)), w),
            _controller_tail(gains) / nearest,
            ends.noise_gain_at_rest,
        ),
    )


def is_stable(model: ProcessModel, gains: PidGains) -> bool:
    """Return whether the closed loop is stable."""
    _, L = _resolved(
        lambda w: controller_response(gains, w) * frequency_response(model, w), frequency_grid(model, gains)
    )
    return _encircles_nothing(_ends(model, gains), L)


def frequency_grid(model: ProcessModel, gains: PidGains) -> FloatArray:
    """Return frequencies (rad/s, increasing) that resolve the loop: its corners by decades, its dead time by turns."""
    r = model.rational()
    times = [time for time in (gains.Ti, gains.Td, gains.Tf, model.D) if 0.0 < time < math.inf]
    corners = [*_corners(r.a), *_corners((*r.b, 0.0)), *(1.0 / time for time in times)] or [1.0]
    high = min(max(corners), min(corners) * 10.0**WIDEST) * 10.0**DECADES
    low = min(corners) / 10.0**DECADES
    grid = np.geomspace(low, high, math.ceil(POINTS_PER_DECADE * math.log10(high / low)))
    if model.D > 0.0:
        even = np.arange(1, round(TURNS * 2.0 * math.pi / EVEN_STEP_RAD)) * EVEN_STEP_RAD / model.D
        grid = np.concatenate((grid, even))
    return np.unique(grid)


def _resolved(loop: Callable[[FloatArray], ComplexArray], w: FloatArray) -> tuple[FloatArray, ComplexArray]:
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


def _corners(polynomial: tuple[float, float, float]) -> list[float]:
    """Return the magnitudes of the roots of `c0 + c1 s + c2 s^2`, none at the origin."""
    return [float(abs(root)) for root in _roots(polynomial) if root != 0.0]


def _roots(polynomial: tuple[float, float, float]) -> ComplexArray:
    roots: ComplexArray = np.roots(np.trim_zeros(np.array(polynomial[::-1]), "f")).astype(complex)
    return roots


@dataclass(frozen=True, slots=True)
class _Ends:
    """What the path of `1 + L` does outside the grid: start towards w = 0, poles, and the loop gain at infinity."""

    integrators: int
    dc_gain: float
    low_gain: float
    unstable_poles: int
    tail: float
    delayed: bool

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


def _ends(model: ProcessModel, gains: PidGains) -> _Ends:
    r = model.rational()
    integrating = r.a[0] == 0.0
    lowest = r.b[0] / (r.a[1] if integrating else r.a[0])
    integral = math.isfinite(gains.Ti)
    return _Ends(
        integrators=integrating + integral,
        dc_gain=math.inf if integrating else lowest,
        low_gain=lowest * (gains.Ki if integral else gains.Kp),
        unstable_poles=int(np.sum(_roots(r.a).real > 0.0)),
        tail=_loop_tail(model, gains),
        delayed=model.D > 0.0,
    )


def _loop_tail(model: ProcessModel, gains: PidGains) -> float:
    """Return the loop gain at infinite frequency, sign included; the dead time turns it for ever."""
    r = model.rational()
    numerator = r.b if r.b[1] != 0.0 else r.b[:1]
    denominator = r.a if r.a[2] != 0.0 else r.a[:2]
    excess = len(denominator) - len(numerator)
    excess += (2 if gains.Tf > 0.0 else 0) - (1 if gains.Td > 0.0 else 0)
    if excess > 0:
        return 0.0
    leading = gains.Kp * (gains.Td or 1.0) / (gains.Tf**2 / 2.0 or 1.0) * numerator[-1] / denominator[-1]
    return leading if excess == 0 else math.copysign(math.inf, leading)


def _controller_tail(gains: PidGains) -> float:
    """Return `|C F|` at infinite frequency."""
    if gains.Tf > 0.0:
        return 0.0
    return math.inf if gains.Td > 0.0 else abs(gains.Kp)


def _encircles_nothing(ends: _Ends, L: ComplexArray) -> bool:
    """Return whether Nyquist's criterion holds: no closed-loop pole right of the axis."""
    if math.isinf(ends.tail) or (ends.delayed and abs(ends.tail) >= 1.0) or ends.start == 0.0:
        return False
    f = 1.0 + L
    end = 1.0 if ends.delayed else 1.0 + ends.tail
    path = np.concatenate(([ends.start], f, [end]))
    if np.any(path == 0.0):
        return False
    turned = float(np.sum(np.angle(path[1:] / path[:-1])))
    return round(ends.unstable_poles - turned / math.pi + ends.integrators / 2.0) == 0


def _peak(response: Callable[[FloatArray], ComplexArray], w: FloatArray) -> float:
    """Return the largest magnitude, refined between the neighbours of the three highest points of the grid."""
    size = np.abs(response(w))
    inner = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])) + 1
    highest = float(np.max(size))
    for i in inner[np.argsort(size[inner])[-3:]]:
        low, high = w[i - 1], w[i + 1]
        for _ in range(4):
            fine = np.linspace(low, high, 17)
            fine_size = np.abs(response(fine))
            k = int(np.clip(np.argmax(fine_size), 1, 15))
            low, high = fine[k - 1], fine[k + 1]
            highest = max(highest, float(np.max(fine_size)))
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
    return float(brentq(function, low, high, xtol=1e-14 * low, rtol=1e-13))
