"""Gains in the device: written, confirmed, restored."""
