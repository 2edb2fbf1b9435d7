"""Packages that need both the tuner and the simulator: the thesis's reproduction and trained models."""
