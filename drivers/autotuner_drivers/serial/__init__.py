"""Driver `serial`: controllers and boards with a protocol of their own on a serial line."""

from autotuner_drivers.serial.backend import SerialBackend, create

__all__ = ["SerialBackend", "create"]
