"""Errors of estimates: covariance, and 95 % intervals by profile likelihood."""
