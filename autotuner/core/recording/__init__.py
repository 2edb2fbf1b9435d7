"""Recordings: samples of one loop with their settings, their CSV form, and the quality of the line to the device."""

from autotuner.core.recording.recording import Recording, Sample

__all__ = ["Recording", "Sample"]
