"""Gains in the device: written, confirmed, put back."""
