"""Simulated plants and devices. Imports nothing of the tuner, so that it can judge it."""
