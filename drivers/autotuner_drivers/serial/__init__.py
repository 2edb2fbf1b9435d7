"""Driver `serial`: controllers and boards with their own protocol on a serial line."""

from autotuner_drivers.serial.backend import SerialBackend, create

__all__ = ["SerialBackend", "create"]
