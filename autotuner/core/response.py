"""Exact response of a process model to a held output, at any sampling.

    x' = A x + B u(t - D),   y = C x

`u` is constant between its changes (zero-order hold), so over an interval `h` with constant input the state moves by
`x+ = Phi x + Gamma u`, `Phi = e^{A h}`, exactly. With `s = tr(A)/2` and `d = sqrt(s^2 - det A)` (real or imaginary),

    e^{A h} = (e^{(s+d)h} + e^{(s-d)h})/2 I + (e^{(s+d)h} - e^{(s-d)h})/(2 d) (A - s I)

(Cayley-Hamilton for 2x2; Moler and Van Loan, SIAM Review 45, 2003). The dead time moves the changes of `u`, not the
samples, so it needs no rounding. The recurrence is run by composition of affine maps in pairs, `O(N log N)` in NumPy,
for any spacing of the samples.

`t` s, `u` output units as deviation from the starting output, `y` PV units as deviation from the starting PV.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel


def response(model: ProcessModel, t: FloatArray, output: FloatArray, at: FloatArray | None = None) -> FloatArray:
    """Return the PV (deviation) of a process that was at rest before `t[0]`.

    Parameters
    ----------
    model : ProcessModel
        The process.
    t : array of float, shape (N,)
        Times, s, not decreasing; `output[k]` is held from `t[k]` to `t[k + 1]`, the last one for ever.
    output : array of float, shape (N,)
        Output, as deviation from the output before `t[0]`.
    at : array of float, shape (M,), optional
        Times at which the PV is wanted, s, not decreasing, none before `t[0]`; `t` by default.

    Returns
    -------
    array of float, shape (M,)
        PV, as deviation from the PV before `t[0]`.
    """
    wanted = t if at is None else at
    changes = np.flatnonzero(np.diff(output, prepend=0.0))
    switch_times = t[changes] + model.D
    levels = np.concatenate(([0.0], output[changes]))
    grid = np.concatenate((switch_times, wanted))
    order = np.argsort(grid, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(grid.size)
    times = grid[order]
    held = levels[np.searchsorted(switch_times, times[:-1], side="right")]
    y, jump = _held_response(model, np.diff(times), held)
    result: FloatArray = y[rank[changes.size :]]
    if jump:
        result = result + jump * levels[np.searchsorted(switch_times, wanted, side="right")]
    return result


def _held_response(model: ProcessModel, h: FloatArray, u: FloatArray) -> tuple[FloatArray, float]:
    """Return the PV at the ends of the intervals `h` from rest, and the direct feed-through (0 unless of order 0)."""
    r = model.rational()
    if r.a[2] == 0.0:
        pole, gain = -r.a[0] / r.a[1], r.b[0] / r.a[1]
        feed = r.b[1] / r.a[1]
        phi = np.exp(pole * h)
        gamma = (gain + feed * pole) * _integral_of_exponential(pole, h, phi)
        return np.concatenate(([0.0], _scan_scalar(phi, gamma * u))), feed
    return np.concatenate(([0.0], _second_order(r.b, r.a, h, u))), 0.0


def _integral_of_exponential(pole: float, h: FloatArray, phi: FloatArray) -> FloatArray:
    """Return the integral of `e^{pole s}` for `s` from 0 to `h`."""
    if pole == 0.0:
        return h
    return np.where(np.abs(pole * h) < 1e-5, np.expm1(pole * h) / pole, (phi - 1.0) / pole)


def _second_order(b: tuple[float, float], a: tuple[float, float, float], h: FloatArray, u: FloatArray) -> FloatArray:
    """Return the output of `(b0 + b1 s)/(a0 + a1 s + a2 s^2)` at the ends of the intervals, from rest."""
    q0, q1 = a[0] / a[2], a[1] / a[2]
    mean = -q1 / 2.0
    root = np.sqrt(complex(mean * mean - q0))
    fast, slow = np.exp((mean + root) * h), np.exp((mean - root) * h)
    even = ((fast + slow) / 2.0).real
    odd = _divided_difference(fast, slow, root, mean, h)
    p00, p01, p10, p11 = even - mean * odd, odd, -q0 * odd, even + (-q1 - mean) * odd
    # Gamma is the integral of the second column of e^{A s}: first entry from x1' = x2, second entry is p01 itself.
    g0, g1 = _integral_of_odd(q0, q1, p01, p11, h), p01
    x0, x1 = _scan_matrix((p00, p01, p10, p11), (g0 * u, g1 * u))
    result: FloatArray = (b[0] * x0 + b[1] * x1) / a[2]
    return result


def _divided_difference(fast: np.ndarray, slow: np.ndarray, root: complex, mean: float, h: FloatArray) -> FloatArray:
    """Return `(e^{(s+d)h} - e^{(s-d)h})/(2 d)`, by its series where `d h` is small."""
    small = np.abs(root * h) < 1e-4
    direct = ((fast - slow) / (2.0 * root)).real if root != 0.0 else np.zeros_like(h)
    series = np.exp(mean * h) * h * (1.0 + ((root * h) ** 2).real / 6.0)
    result: FloatArray = np.where(small, series, direct)
    return result


def _integral_of_odd(q0: float, q1: float, p01: FloatArray, p11: FloatArray, h: FloatArray) -> FloatArray:
    """Return the integral of `p01` over the interval, from `p01'' + q1 p01' + q0 p01 = 0`, `p01' = p11`."""
    if q0 == 0.0:
        return (h - p01) / q1 if q1 != 0.0 else h * h / 2.0
    exact = (1.0 - p11 - q1 * p01) / q0
    series = h * h * (0.5 - q1 * h / 6.0 + (q1 * q1 - q0) * h * h / 24.0)
    return np.where((abs(q1) + np.sqrt(abs(q0))) * h < 2e-3, series, exact)


def _scan_scalar(phi: FloatArray, g: FloatArray) -> FloatArray:
    """Return `x_k = phi_k x_{k-1} + g_k` for all k, `x_{-1} = 0`."""
    phi, x = phi.copy(), g.copy()
    step = 1
    while step < x.size:
        x[step:] = x[step:] + phi[step:] * x[:-step]
        phi[step:] = phi[step:] * phi[:-step]
        step *= 2
    return x


def _scan_matrix(
    p: tuple[FloatArray, FloatArray, FloatArray, FloatArray], g: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return `x_k = P_k x_{k-1} + g_k` for all k with 2x2 matrices, `x_{-1} = 0`."""
    a, b, c, d = (v.copy() for v in p)
    x, y = (v.copy() for v in g)
    step = 1
    while step < x.size:
        now, before = slice(step, None), slice(None, -step)
        x[now], y[now] = (
            x[now] + a[now] * x[before] + b[now] * y[before],
            y[now] + c[now] * x[before] + d[now] * y[before],
        )
        a[now], b[now], c[now], d[now] = (
            a[now] * a[before] + b[now] * c[before],
            a[now] * b[before] + b[now] * d[before],
            c[now] * a[before] + d[now] * c[before],
            c[now] * b[before] + d[now] * d[before],
        )
        step *= 2
    return x, y
