"""Driver `epics`: channels of EPICS input/output controllers by Channel Access."""

from autotuner_drivers.epics.backend import create

__all__ = ["create"]
