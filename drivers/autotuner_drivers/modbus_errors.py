"""What went wrong on a Modbus line, as the errors of the port, in tables."""

from __future__ import annotations

from typing import Final

from pymodbus.exceptions import ConnectionException, ModbusIOException

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner_drivers.link_errors import CHECK_LINE, REPEAT, GarbledAnswerError, Row, error_of, link_error
from autotuner_drivers.modbus_exchange import UnreadableAnswerError

_LIBRARY: Final[dict[type[Exception], Row]] = {
    ModbusIOException: (
        DeviceTimeoutError,
        "did not answer within {timeout_s:g} s",
        "Check the unit number and the line, or raise timeout_s.",
    ),
    ConnectionException: (LinkError, "lost the connection", CHECK_LINE),
    UnreadableAnswerError: (GarbledAnswerError, "sent an answer that cannot be decoded", REPEAT),
}

EXCEPTION_CODES: Final[dict[int, Row]] = {
    1: (
        DeviceRefusedError,
        "illegal function",
        "Set use_fc5, use_fc6 or use_fc16 to false when the device lacks that function code.",
    ),
    2: (
        DeviceRefusedError,
        "illegal data address",
        "Check table and address of the registers (manuals often count from 1), and max_gap.",
    ),
    3: (
        DeviceRefusedError,
        "illegal data value",
        "The value may be out of the device's range, or the read longer than it allows: see max_registers_per_read.",
    ),
    4: (DeviceRefusedError, "device failure", "Look at the device: it reports a fault of its own."),
    5: (DeviceRefusedError, "acknowledged, but not yet done", "Repeat the request later."),
    6: (DeviceRefusedError, "device busy", "Repeat the request later, or use a longer sample time."),
    8: (DeviceRefusedError, "memory parity error", "Look at the device: it reports a fault of its own."),
    10: (LinkError, "gateway path unavailable", "Check the gateway's configuration and the unit number."),
    11: (DeviceTimeoutError, "no answer from the device behind the gateway", "Check the device and the unit number."),
}
"""Exception codes of the protocol (V1.1b3, section 7)."""

_UNKNOWN_CODE: Final[Row] = (DeviceRefusedError, "not in the standard", "See the device's manual.")


def driver_error(error: Exception, device: str, timeout_s: float) -> DriverError:
    """Return the error of the port for an exception of the library, the socket or the serial port."""
    row = _LIBRARY.get(type(error))
    return error_of(row, error, device, timeout_s) if row else link_error(error, device, timeout_s)


def refusal(code: int, device: str) -> DriverError:
    """Return the error of the port for an exception answer."""
    kind, meaning, remedy = EXCEPTION_CODES.get(code, _UNKNOWN_CODE)
    return kind(f"{device} answered exception {code} ({meaning})", remedy=remedy)
