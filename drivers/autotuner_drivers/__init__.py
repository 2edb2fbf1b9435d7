"""Drivers: one module for each way to reach a loop."""
