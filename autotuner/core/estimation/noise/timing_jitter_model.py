"""Timing jitter: noise on the PV by uncertain times of the output's changes.

    pv = y + J e + noise,   e_i ~ N(mu_i, s_i^2),   noise ~ N(0, s^2)
    V/s^2 = I + B B',   B = J diag(s_i)/s,   B'B = W diag(d^2) W'
    (V/s^2)^{-1/2} = I - B W diag(1/(r (1 + r))) W' B',   (V/s^2)^{-1} = I - B W diag(1/r^2) W' B',   r = sqrt(1 + d^2)

`J` (N, C) slopes of the PV to the times of the C changes, PV/s; `e` their shifts, s. The errors of the times are
not searched but integrated out, and least squares continues after the last operator, which costs `O(N C)` for each
column. (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, ch. 2.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature


@dataclass(frozen=True, slots=True, eq=False)
class TimingJitterModel:
    """The noise's low-rank part.

    Attributes
    ----------
    columns : array of float, shape (N, C)
        `B` above.
    turned : array of float, shape (N, C)
        `B W`, for the samples that count.
    square : array of float, shape (C,)
        `d^2`.
    sigma : float
        `s`.
    """

    columns: FloatArray
    turned: FloatArray
    square: FloatArray
    sigma: float

    @classmethod
    def of(cls, columns: FloatArray, weight: FloatArray, sigma: float) -> TimingJitterModel:
        """Make it of `B`, the weights of the samples, and `s`."""
        counting = columns * weight[:, None]
        square, directions = np.linalg.eigh(counting.T @ counting)
        return cls(columns, counting @ directions, np.maximum(square, 0.0), sigma)

    def whitened(self, values: FloatArray) -> FloatArray:
        """Return weighted columns, or a single one, after the operator."""
        root = np.sqrt(1.0 + self.square)
        result: FloatArray = values - (self.turned / (root * (1.0 + root))) @ (self.turned.T @ values)
        return result

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of `V/s^2`."""
        return float(np.sum(np.log1p(self.square)))

    def shifts(self, residual: FloatArray, weight: FloatArray) -> FloatArray:
        """Return the most likely `(e - mu)/s_i` for a weighted residual `pv - y - J mu`, shape (C,)."""
        left = residual - (self.turned / (1.0 + self.square)) @ (self.turned.T @ residual)
        result: FloatArray = (self.columns * weight[:, None]).T @ left / self.sigma
        return result
