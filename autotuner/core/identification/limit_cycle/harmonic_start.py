"""Process models from the harmonics of a relay oscillation, vectorised: the start of the learned correction.

    G(jw) = e^{-j phi} K U1/(A1 r),   r = K U1/A1                        w = 2 pi/Pu
    FOPDT         w T = sqrt(r^2 - 1),   w D = phi - atan(w T)
    second order  m w^2 = 1 - r cos psi,  n w = r sin psi,  w D = phi - psi
    integrating   w T = tan psi,  w D = phi - pi/2 - psi,  K = w A1/U1 sqrt(1 + (w T)^2)

Each matches the fundamental exactly; `psi` minimises the squared error of the higher harmonics

    y_k = r u_k e^{-j k w D}/(1 - k^2 m w^2 + j k n w)   or   u_k sqrt(1 + (w T)^2) e^{-j k w D}/(j k (1 + j k w T))

`y_k`, `u_k` as in `relay_harmonics`. Without noise and with fast sampling no error remains.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner.core.identification.limit_cycle.relay_harmonics import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.identification.limit_cycle.relay_harmonics import RelayWaves
    from autotuner.core.model.arrays import ComplexArray, FloatArray

    Family = Callable[[FloatArray, FloatArray, FloatArray], "Shape"]

COARSE, FINE, ROUNDS = 48, 9, 7
"""Values of psi in the first search, and in each narrower one around the best."""
SMALLEST = 1e-3
"""Smallest time, in `1/w`, that a start may have."""
FORBIDDEN = 1e3
"""Misfit of a psi that no process of the structure has."""
K_ORDER = np.arange(1.0, HARMONICS + 1.0)


class Shape(NamedTuple):
    """Candidates for each wave: denominators of the response at the harmonics, dead time, and whether it exists."""

    response: ComplexArray
    delay: FloatArray
    exists: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


class Starts(NamedTuple):
    """Start values, one an element.

    Attributes
    ----------
    values : array of float, shape (B, P)
        In the structure's own coordinates, see `COORDINATES`.
    missed : array of complex, shape (B, 5)
        Measured harmonics minus those of the start.
    misfit : array of float, shape (B,)
        Their root mean square over the harmonics 2 to 5.
    exists : array of bool, shape (B,)
        Whether a process of the structure can have such a fundamental.
    """

    values: FloatArray
    missed: ComplexArray
    misfit: FloatArray
    exists: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


COORDINATES: dict[str, tuple[str, ...]] = {
    "fopdt": ("log wT", "wD", "log r"),
    "sopdt_overdamped": ("log wT1", "log wT2", "wD", "log r"),
    "sopdt_underdamped": ("log mw2", "log nw", "wD", "log r"),
    "integrating": ("log(1+wT)", "wD", "log r"),
}
"""Dimensionless coordinates of each structure; `r = K U1/A1`, over `w` when integrating."""


def start(structure: str, wave: RelayWaves, r: FloatArray) -> Starts:
    """Return start values of a structure; `r` the static gain times `U1/A1`, not used when integrating."""
    lag = -np.angle(wave.y[:, 0]) % (2.0 * math.pi)
    if structure == "fopdt":
        return _first_order(wave, r, lag)
    family, low, high = FAMILIES[structure](r, lag)
    psi = _best(family, wave, r, lag, (low, high))
    shape = family(r, lag, psi[:, None])
    missed = wave.y - (wave.u[:, None, :] * shape.response)[:, 0]
    values = _VALUES[structure](r, lag, psi)
    exists = shape.exists[:, 0] & (high > low) & np.isfinite(values).all(axis=1)
    return Starts(values, missed, _rms(missed), exists)


def _first_order(wave: RelayWaves, r: FloatArray, lag: FloatArray) -> Starts:
    wT = np.sqrt(np.maximum(r * r - 1.0, SMALLEST**2))
    wD = lag - np.arctan(wT)
    response = r[:, None] * np.exp(-1j * K_ORDER * wD[:, None]) / (1.0 + 1j * K_ORDER * wT[:, None])
    missed = wave.y - wave.u * response
    return Starts(np.stack((np.log(wT), wD, np.log(r)), axis=1), missed, _rms(missed), (r > 1.0) & (wD > 0.0))


def _second(overdamped: bool) -> Family:  # noqa: FBT001 - one of two halves
    def family(r: FloatArray, lag: FloatArray, psi: FloatArray) -> Shape:
        a, b = 1.0 - r[:, None] * np.cos(psi), r[:, None] * np.sin(psi)
        delay = lag[:, None] - psi
        k = K_ORDER
        shape = r[:, None, None] / (1.0 - k * k * a[..., None] + 1j * k * b[..., None])
        right = (b * b >= 4.0 * a * (1.0 - 1e-9)) if overdamped else (b * b < 4.0 * a)
        exists = (a > 0.0) & (b > 0.0) & (delay >= 0.0) & right
        return Shape(shape * np.exp(-1j * k * delay[..., None]), delay, exists)

    return family


def _integrating(_r: FloatArray, lag: FloatArray, psi: FloatArray) -> Shape:
    wT = np.tan(psi)
    delay = lag[:, None] - math.pi / 2.0 - psi
    k = K_ORDER
    shape = np.sqrt(1.0 + wT * wT)[..., None] / (1j * k * (1.0 + 1j * k * wT[..., None]))
    return Shape(shape * np.exp(-1j * k * delay[..., None]), delay, delay >= 0.0)


def _span_second(r: FloatArray, lag: FloatArray) -> tuple[FloatArray, FloatArray]:
    low = np.arccos(np.minimum(1.0 / r, 1.0))
    return low + 1e-6, np.minimum(lag, math.pi) - 1e-6


FAMILIES: dict[str, Callable[[FloatArray, FloatArray], tuple[Family, FloatArray, FloatArray]]] = {
    "sopdt_overdamped": lambda r, lag: (_second(overdamped=True), *_span_second(r, lag)),
    "sopdt_underdamped": lambda r, lag: (_second(overdamped=False), *_span_second(r, lag)),
    "integrating": lambda _r, lag: (
        _integrating,
        np.full(lag.size, 1e-6),
        np.minimum(lag - math.pi / 2.0, math.pi / 2.0 - SMALLEST),
    ),
}


def _best(
    family: Family, wave: RelayWaves, r: FloatArray, lag: FloatArray, span: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the psi of least misfit: a coarse search, then narrower ones around the best, then a parabola."""
    low, high = span[0], np.maximum(span[1], span[0] + 1e-9)
    psi = low
    for count in (COARSE, *(FINE,) * ROUNDS):
        psis = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, count)
        shape = family(r, lag, psis)
        away = np.abs(wave.y[:, None, 1:] - wave.u[:, None, 1:] * shape.response[..., 1:]) ** 2
        misfit = np.where(shape.exists, away.sum(axis=2), FORBIDDEN)
        best = misfit.argmin(axis=1)
        psi, step = psis[np.arange(best.size), best], (high - low) / (count - 1)
        low, high = np.maximum(span[0], psi - step), np.minimum(np.maximum(span[1], span[0] + 1e-9), psi + step)
    return psi


def _rms(missed: ComplexArray) -> FloatArray:
    rms: FloatArray = np.sqrt((np.abs(missed[:, 1:]) ** 2).mean(axis=1))
    return rms


def _lags(r: FloatArray, lag: FloatArray, psi: FloatArray) -> FloatArray:
    a, b = 1.0 - r * np.cos(psi), r * np.sin(psi)
    root = np.sqrt(np.maximum(b * b / 4.0 - a, 0.0))
    T1 = np.maximum(b / 2.0 + root, SMALLEST)
    return np.stack((np.log(T1), np.log(np.maximum(a / T1, SMALLEST)), lag - psi, np.log(r)), axis=1)


def _pair(r: FloatArray, lag: FloatArray, psi: FloatArray) -> FloatArray:
    a, b = 1.0 - r * np.cos(psi), r * np.sin(psi)
    return np.stack((np.log(np.maximum(a, SMALLEST**2)), np.log(np.maximum(b, SMALLEST)), lag - psi, np.log(r)), axis=1)


def _ramp(_r: FloatArray, lag: FloatArray, psi: FloatArray) -> FloatArray:
    wT = np.tan(psi)
    return np.stack((np.log1p(wT), lag - math.pi / 2.0 - psi, np.log(np.sqrt(1.0 + wT * wT))), axis=1)


_VALUES = {"sopdt_overdamped": _lags, "sopdt_underdamped": _pair, "integrating": _ramp}
