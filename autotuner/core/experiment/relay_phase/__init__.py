"""The relay phase of an experiment: oscillation, adjustment of bias and amplitude, and the check."""
