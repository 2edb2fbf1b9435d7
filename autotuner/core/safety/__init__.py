"""Supervisor of an experiment and the watches that it consults before every write."""
