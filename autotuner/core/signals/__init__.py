"""Streaming filters and detectors, and measurements of a limit cycle."""
