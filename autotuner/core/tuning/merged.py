"""Two lags that a record cannot tell apart.

    K e^{-Ds} / ((T1 s + 1)(T2 s + 1)) = K e^{-Ds} / (m s^2 + n s + 1),   n = T1 + T2,   m = T1 T2

Where the lags are nearly equal, their errors are not those of a quadratic: the record tells `n` and `m`, and beyond
equal lags the same process rings. So a covariance is that of `(K, m, n, D)` there, and the models of its region may be
of either kind.

`K` PV/output, `m` s^2, `n`, `T1`, `T2`, `D` s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from autotuner.core.process import Rational

if TYPE_CHECKING:
    from autotuner.core.process import SopdtOverdamped


@dataclass(frozen=True, slots=True)
class MergedLags:
    """Two lags by their sum and product, `K e^{-Ds} / (m s^2 + n s + 1)`, whatever the damping."""

    structure: ClassVar[str] = "merged_lags"
    K: float
    m: float
    n: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (1.0, self.n, self.m))

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""
        return {"K": self.K, "m": self.m, "n": self.n, "D": self.D}


def merged(model: SopdtOverdamped) -> MergedLags:
    """Return two lags by their sum and product."""
    return MergedLags(model.K, model.T1 * model.T2, model.T1 + model.T2, model.D)
