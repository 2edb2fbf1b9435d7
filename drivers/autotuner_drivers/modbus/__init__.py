"""Driver `modbus`: Modbus TCP, TLS, RTU and RTU over TCP."""

from autotuner_drivers.modbus.backend import ModbusBackend, create

__all__ = ["ModbusBackend", "create"]
