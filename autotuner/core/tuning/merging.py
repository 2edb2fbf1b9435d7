"""Two lags that a record cannot tell apart.

    K (1 - Z s) e^{-Ds} / ((T1 s + 1)(T2 s + 1)) = K (1 - Z s) e^{-Ds} / (m s^2 + n s + 1),   n = T1 + T2,   m = T1 T2

Where the lags are nearly equal, their errors are not those of a quadratic: the record tells `n` and `m`, and beyond
equal lags the same process rings. So a covariance is that of `(K, m, n, Z, D)` there, and the models of its region
may be of either kind.

`K` PV/output, `m` s^2, `n`, `T1`, `T2`, `Z`, `D` s; `Z` is 0, and no parameter, without an inverse response.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from autotuner.core.process import InverseResponse, Rational, SopdtOverdamped

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel


@dataclass(frozen=True, slots=True)
class MergedLags:
    """Two lags by their sum and product, whatever the damping."""

    structure: ClassVar[str] = "merged_lags"
    K: float
    m: float
    n: float
    D: float
    Z: float = 0.0

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, -self.K * self.Z), (1.0, self.n, self.m))

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""
        zero = {"Z": self.Z} if self.Z else {}
        return {"K": self.K, "m": self.m, "n": self.n, **zero, "D": self.D}


def merged(model: SopdtOverdamped | InverseResponse) -> MergedLags:
    """Return two lags by their sum and product."""
    Z = model.Z if isinstance(model, InverseResponse) else 0.0
    return MergedLags(model.K, model.T1 * model.T2, model.T1 + model.T2, model.D, Z)


def known_within(
    model: ProcessModel, covariance: FloatArray | None, pair_covariance: FloatArray | None
) -> tuple[FloatArray | None, ProcessModel | None]:
    """Return how well a process is known, and the process by its parameters where those are not the model's.

    Parameters
    ----------
    model : ProcessModel
        The process.
    covariance, pair_covariance : array of float, shape (P, P), or None
        Of ``model.parameters()``, and of its merged lags; one that is not finite tells nothing.
    """
    if pair_covariance is not None and isinstance(model, SopdtOverdamped | InverseResponse):
        return _finite(pair_covariance), merged(model)
    return _finite(covariance), None


def _finite(covariance: FloatArray | None) -> FloatArray | None:
    return covariance if covariance is not None and bool(np.all(np.isfinite(covariance))) else None
