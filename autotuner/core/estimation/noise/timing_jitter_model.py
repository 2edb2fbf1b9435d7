"""Timing jitter: noise on the PV by uncertain times of the output's changes.

    pv = y + J e + noise,   e_i ~ N(mu_i, s_i^2),   noise ~ N(0, s^2)
    V/s^2 = I + B B',   B = J diag(s_i)/s = U d W',   (V/s^2)^{-1/2} = I - U diag(1 - 1/sqrt(1 + d^2)) U'

`J` (N, C) slopes of the PV to the times of the C changes, PV/s; `e` their shifts, s. The errors of the times are
not searched but integrated out, and least squares continues after the last operator, which costs `O(N C)` for each
column. (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, ch. 2.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature


@dataclass(frozen=True, slots=True, eq=False)
class Shaken:
    """The noise's low-rank part.

    Attributes
    ----------
    columns : array of float, shape (N, C)
        `B` above.
    basis : array of float, shape (N, C)
        `U`, for the samples that count.
    size : array of float, shape (C,)
        `d`.
    sigma : float
        `s`.
    """

    columns: FloatArray
    basis: FloatArray
    size: FloatArray
    sigma: float

    @classmethod
    def of(cls, columns: FloatArray, weight: FloatArray, sigma: float) -> Shaken:
        """Make it of `B`, the weights of the samples, and `s`."""
        basis, size, _ = np.linalg.svd(columns * weight[:, None], full_matrices=False)
        return cls(columns, basis, size, sigma)

    def whitened(self, values: FloatArray) -> FloatArray:
        """Return weighted columns, or a single one, after the operator."""
        shrink = 1.0 - 1.0 / np.hypot(1.0, self.size)
        result: FloatArray = values - (self.basis * shrink) @ (self.basis.T @ values)
        return result

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of `V/s^2`."""
        return float(np.sum(np.log1p(self.size**2)))

    def shifts(self, residual: FloatArray, weight: FloatArray) -> FloatArray:
        """Return the most likely `(e - mu)/s_i` for a weighted residual `pv - y - J mu`, shape (C,)."""
        back = (self.basis / (1.0 + self.size**2)) @ (self.basis.T @ residual)
        rest = residual - self.basis @ (self.basis.T @ residual)
        result: FloatArray = (self.columns * weight[:, None]).T @ (back + rest) / self.sigma
        return result
