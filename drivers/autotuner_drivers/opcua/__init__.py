"""Driver `opcua`: nodes of an OPC UA server."""

from autotuner_drivers.opcua.backend import create

__all__ = ["create"]
