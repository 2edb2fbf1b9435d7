"""Recordings: samples of one loop with their settings, their CSV form, and the quality of the line they came over."""

from autotuner.core.recording.recording import Recording, Sample

__all__ = ["Recording", "Sample"]
