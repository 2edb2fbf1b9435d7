"""Linear least squares by orthogonal columns; a column that depends on earlier ones is omitted."""

from __future__ import annotations

import numpy as np
import scipy

from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature

DEPENDENT = 1e-10
"""Length of the orthogonal part of a unit column below which it counts as dependent on the earlier ones."""


def solve_linear(columns: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of the columns and the least-squares coefficients, 0 for a dependent column.

    Parameters
    ----------
    columns : array of float, shape (N, L)
        What the target is made of.
    target : array of float, shape (N,)
        What is to be matched.
    """
    size = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    size[size == 0.0] = 1.0
    q, r = _orthogonal(columns / size)
    independent = np.flatnonzero(np.abs(r.diagonal()) > DEPENDENT)
    if independent.size < size.size:
        q, r = _orthogonal(columns[:, independent] / size[independent])
    coefficients = np.zeros(size.size)
    if independent.size:
        coefficients[independent] = (
            scipy.linalg.lapack.dtrtrs(r.T, q.T @ target, lower=1, trans=1)[0] / size[independent]
        )
    return q, coefficients


def _orthogonal(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the factors of the columns by LAPACK itself: for so few columns SciPy's checks take longer than they."""
    rank = min(columns.shape)
    if rank == 0:
        return np.zeros((columns.shape[0], 0)), np.zeros((0, columns.shape[1]))
    factors, reflections, _, _ = scipy.linalg.lapack.dgeqrf(columns)
    r = factors[:rank].copy()
    q: FloatArray = scipy.linalg.lapack.dorgqr(factors[:, :rank], reflections)[0]
    return q, r


def residual_after(columns: FloatArray, target: FloatArray) -> FloatArray:
    """Return the residual of the target after the projection on the columns."""
    q, _ = solve_linear(columns, target)
    result: FloatArray = target - q @ (q.T @ target)
    return result
