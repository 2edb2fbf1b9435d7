"""Reproduction of the thesis's learned estimates: data sets, regressors, table 5.1, and their accuracy."""
