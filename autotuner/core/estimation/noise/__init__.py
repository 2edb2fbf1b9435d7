"""Noise of a record: autoregressive, of the sample times, and single wild samples."""
