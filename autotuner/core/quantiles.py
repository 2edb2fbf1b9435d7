"""Quantiles and tails of the distributions that intervals and tests are stated by.

They are those of `scipy.stats`, whose import takes as long as a short identification.
"""

from __future__ import annotations

import scipy

NORMAL_95, NORMAL_99 = 1.96, 2.576
"""Standard deviations of a normal distribution on each side of its mean within which 95 and 99 % lie."""
CHI2_95 = 3.841
"""Value under which 95 % of a chi-squared distribution of one degree of freedom lie; the square of `NORMAL_95`."""


def chi2_tail(value: float, freedom: float) -> float:
    """Return the probability that a chi-squared number with some degrees of freedom exceeds a value."""
    return float(scipy.special.chdtrc(freedom, max(value, 0.0)))


def f_tail(value: float, freedom: float, freedom_below: float) -> float:
    """Return the probability that the ratio of two mean squares exceeds a value (Fisher's distribution)."""
    return float(scipy.special.fdtrc(freedom, freedom_below, max(value, 0.0)))


def student_quantile(freedom: float) -> float:
    """Return the half width, in standard errors, of a 95 % interval with some degrees of freedom."""
    return float(scipy.special.stdtrit(freedom, 0.975))
