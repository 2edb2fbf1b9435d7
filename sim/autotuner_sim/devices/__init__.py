"""Simulated devices: a loop with its own controller, a PLC on Modbus, a serial board."""
