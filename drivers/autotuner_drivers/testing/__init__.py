"""Checks of drivers and devices: the conformance kit and the probe."""
