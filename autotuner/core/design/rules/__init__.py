"""Tuning rules of the literature as rows of a table, and the model reductions that they need."""
