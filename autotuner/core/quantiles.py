"""Quantiles of the distributions that intervals are stated by."""

NORMAL_95 = 1.96
"""Standard deviations of a normal distribution on each side of its mean within which 95 % lie."""
CHI2_95 = 3.841
"""Value under which 95 % of a chi-squared distribution of one degree of freedom lie; the square of `NORMAL_95`."""
