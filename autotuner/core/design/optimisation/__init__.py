"""Gains by optimisation: least error within limits of robustness, for a model with its errors."""
