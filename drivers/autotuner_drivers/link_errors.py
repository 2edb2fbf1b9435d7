"""What goes wrong on sockets and serial ports, as the errors of the port, in tables."""

from __future__ import annotations

import errno
import ssl
from typing import Final

from serial import SerialException  # type: ignore[import-untyped]  # pyserial has no type hints

from autotuner.errors import DeviceTimeoutError, DriverError, LinkError

CHECK_LINE: Final = "Check that the device is on, its address and port, and that no other client holds it."
REPEAT: Final = "Check the line and the device's documentation; the request may simply be repeated."
_CHECK_GROUP: Final = "Add the user to the group that owns the port, often dialout."
_CHECK_OTHERS: Final = "End the other program, or use another port."


class GarbledAnswerError(LinkError):
    """Something came that is not the answer to the request."""


Row = tuple[type[DriverError], str, str]
"""Class, message and remedy."""

_SERIAL: Final[dict[int, Row]] = {
    errno.ENOENT: (LinkError, "does not exist", "Check the name of the port, and that the adapter is plugged in."),
    errno.EACCES: (LinkError, "may not be opened: permission denied", _CHECK_GROUP),
    errno.EPERM: (LinkError, "may not be opened: permission denied", _CHECK_GROUP),
    errno.EBUSY: (LinkError, "is in use by another program", _CHECK_OTHERS),
    errno.EAGAIN: (LinkError, "is in use by another program", _CHECK_OTHERS),
}
"""Serial ports, by the number of the error."""

_BY_CLASS: Final[dict[type[Exception], Row]] = {
    ssl.SSLCertVerificationError: (
        LinkError,
        "showed a certificate that is not trusted: {error}",
        "Give the signer's certificate as ca_file and the name in the device's certificate as server_name.",
    ),
    TimeoutError: (DeviceTimeoutError, "could not be connected within {timeout_s:g} s", CHECK_LINE),
    ConnectionRefusedError: (LinkError, "refused the connection", CHECK_LINE),
    ConnectionResetError: (LinkError, "closed the connection", CHECK_LINE),
    OSError: (LinkError, "cannot be reached: {error}", CHECK_LINE),
    Exception: (LinkError, "failed: {error}", REPEAT),
}
"""First match wins."""


def link_error(error: Exception, device: str, timeout_s: float) -> DriverError:
    """Return the error of the port for an exception of a socket or a serial port."""
    by_class = next(row for kind, row in _BY_CLASS.items() if isinstance(error, kind))
    row = _SERIAL.get(error.errno or 0, by_class) if isinstance(error, SerialException) else by_class
    return error_of(row, error, device, timeout_s)


def error_of(row: Row, error: Exception, device: str, timeout_s: float) -> DriverError:
    """Return the error that a row of a table stands for."""
    kind, message, remedy = row
    return kind(f"{device} {message.format(error=error, timeout_s=timeout_s)}", remedy=remedy)


def put_off(why: DriverError, wait_s: float) -> LinkError:
    """Return the error of a call that may not try yet: why the last attempt failed, and when the next is due."""
    return LinkError(f"{why.message}; the next attempt is due in {wait_s:.1f} s", remedy=why.remedy)
