"""What went wrong on a Modbus line, as the errors of the port, in tables."""

from __future__ import annotations

import errno
from typing import Final

from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError

CHECK_LINE: Final = "Check that the device is on, its address and port, and that no other client holds it."
REPEAT: Final = "Check the line and the device's documentation; the request may simply be repeated."


class GarbledAnswerError(LinkError):
    """Something came that is not the answer to the request."""


Row = tuple[type[DriverError], str, str]
"""Class, message and remedy."""

_BY_NUMBER: Final[dict[int, Row]] = {
    errno.ENOENT: (LinkError, "does not exist", "Check the name of the port, and that the adapter is plugged in."),
    errno.EACCES: (LinkError, "may not be opened: permission denied", "Add the user to the port's group (dialout)."),
    errno.EPERM: (LinkError, "may not be opened: permission denied", "Add the user to the port's group (dialout)."),
    errno.EBUSY: (LinkError, "is in use by another program", "End the other program, or use another port."),
    errno.EAGAIN: (LinkError, "is in use by another program", "End the other program, or use another port."),
}
"""Errors of serial ports by number; first match wins."""

_BY_CLASS: Final[dict[type[Exception], Row]] = {
    TimeoutError: (DeviceTimeoutError, "could not be connected within {timeout_s:g} s", CHECK_LINE),
    ModbusIOException: (
        DeviceTimeoutError,
        "did not answer within {timeout_s:g} s",
        "Check the unit number and the line, or raise timeout_s.",
    ),
    ConnectionRefusedError: (LinkError, "refused the connection", CHECK_LINE),
    ConnectionResetError: (LinkError, "closed the connection", CHECK_LINE),
    ConnectionException: (LinkError, "lost the connection", CHECK_LINE),
    OSError: (LinkError, "cannot be reached: {error}", CHECK_LINE),
    ModbusException: (LinkError, "failed: {error}", REPEAT),
}
"""Exceptions of sockets, serial ports and the library; first match wins."""

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
    """Return the error of the port for an exception of the socket, the serial port or the library."""
    number = error.errno if isinstance(error, OSError) else None
    by_class = next((row for kind, row in _BY_CLASS.items() if isinstance(error, kind)), None)
    kind, message, remedy = _BY_NUMBER.get(number or 0) or by_class or (LinkError, "failed: {error}", REPEAT)
    return kind(f"{device} {message.format(error=error, timeout_s=timeout_s)}", remedy=remedy)


def refusal(code: int, device: str) -> DriverError:
    """Return the error of the port for an exception answer."""
    kind, meaning, remedy = EXCEPTION_CODES.get(code, _UNKNOWN_CODE)
    return kind(f"{device} answered exception {code} ({meaning})", remedy=remedy)
