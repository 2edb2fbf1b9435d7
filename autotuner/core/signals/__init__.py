"""Streaming filters and detectors, and what they measure on a limit cycle."""
