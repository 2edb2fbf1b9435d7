"""Driver `mqtt`: a device that talks through an MQTT broker."""

from autotuner_drivers.mqtt.backend import create

__all__ = ["create"]
