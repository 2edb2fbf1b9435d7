"""Sampled-data fit: the pulse transfer function of the relay test by linear least squares.

    y_k = sum_i a_i y_{k-i} + sum_j b_j u_{k-d-j},   i = 1..order, j = 1..order + 1

for every whole delay `d`; the one whose simulated PV is closest counts. With `z = e^{s h}` the poles give the lags,

    FOPDT   T = -h/ln a1,   K = (b1 + b2)/(1 - a1),   b1 = K (1 - a1^{1 - f}),   D = (d + f) h
    SOPDT   n + D = (mean of the pulse response - 1/2) h,   K = sum b/(1 - sum a)

with `h` sample interval (s), `f` the fraction of a sample in the dead time. Source: Chang, Shen and Yu, Ind. Eng. Chem.
Res. 31 (1992). Linear in the samples, so noise on the PV makes it lean towards short lags.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from autotuner.core.model.process import Fopdt, second_order
from autotuner.errors import InputError
from autotuner_models.literature.trial import FOPDT, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial

LONGEST = 0.25
"""Longest dead time tried, in lengths of the record."""


def estimate(trial: Trial) -> ProcessModel:
    """Return the process of the best pulse transfer function."""
    recording = trial.recording(SYMMETRIC)
    h = recording.sample_interval_s
    if float(np.ptp(np.diff(recording.t))) > 1e-6 * h:
        raise InputError("is not equally spaced", field="tests.symmetric.t", remedy="Resample the recording.")
    y, u = recording.pv - recording.pv[0], recording.output - recording.output[0]
    order = 1 if trial.first_order else 2
    fits = [(_fit(y, u, order, d), d) for d in range(int(LONGEST * y.size))]
    coefficients, d = min(fits, key=lambda fit: _misfit(y, u, fit[0][:order], fit[0][order:], fit[1]))
    a, b = coefficients[:order], coefficients[order:]
    return _first_order(a[0], b, d, h) if order == 1 else _second_order(a, b, d, h)


def _fit(y: FloatArray, u: FloatArray, order: int, d: int) -> FloatArray:
    """Return the coefficients for a whole delay, over the same samples for every delay."""
    first = int(LONGEST * y.size) + order + 1
    rows = np.arange(first, y.size)
    columns = [y[rows - i] for i in range(1, order + 1)] + [u[rows - d - j] for j in range(1, order + 2)]
    phi = np.column_stack(columns)
    return np.asarray(np.linalg.lstsq(phi, y[rows], rcond=None)[0], dtype=np.float64)


def _misfit(y: FloatArray, u: FloatArray, a: FloatArray, b: FloatArray, d: int) -> float:
    """Return the sum of squares of the simulated PV; infinite where the transfer function runs away."""
    if np.any(np.abs(np.roots(np.append(1.0, -a))) >= 1.0):
        return math.inf
    delayed = np.concatenate((np.zeros(d + 1), u))[: u.size]
    residual = y - lfilter(b, np.append(1.0, -a), delayed)
    return float(residual @ residual)


def _first_order(a: float, b: FloatArray, d: int, h: float) -> Fopdt:
    if not 0.0 < a < 1.0:
        raise _impossible("a1", a)
    K = float(b.sum()) / (1.0 - a)
    share = min(max(float(b[0]) / K, 0.0), 1.0 - a)
    fraction = 1.0 - math.log1p(-share) / math.log(a)
    return Fopdt(K, -h / math.log(a), (d + fraction) * h)


def _second_order(a: FloatArray, b: FloatArray, d: int, h: float) -> ProcessModel:
    poles = np.log(np.roots([1.0, -a[0], -a[1]]).astype(complex)) / h
    m = float((1.0 / np.prod(poles)).real)
    n = float((-m * poles.sum()).real)
    gain = 1.0 - float(a.sum())
    mean = float((np.arange(1, 4) @ b) / b.sum()) + d + float(np.arange(1, 3) @ a) / gain
    D = (mean - 0.5) * h - n
    if not (m > 0.0 and n > 0.0 and D >= 0.0):
        raise _impossible("m", m)
    return second_order(float(b.sum()) / gain, m, n, D)


def _impossible(name: str, value: float) -> InputError:
    return InputError(f"comes out as {value:.3g}", field=name, remedy="Reduce the noise, or sample less often.")


METHOD = Method("sampled_data", "Sampled data, z-transform (Chang et al.)", FOPDT + SOPDT, estimate, finds_all=True)
