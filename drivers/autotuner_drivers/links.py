"""Links to devices: errors of sockets and serial ports as errors of the port, and the backoff between attempts.

Invariant: pure; time is an argument, s.
"""

from __future__ import annotations

import errno
import ssl
from typing import Final

from serial import SerialException  # type: ignore[import-untyped]  # pyserial has no type hints

from autotuner.errors import DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import FIRST_PAUSE_S, LONGEST_PAUSE_S

REMEMBERED: Final = 64
"""Number of calls in the median of a latency: the last minute at a sample a second."""
SHORTEST_WAIT_S: Final = 0.001
"""Shortest wait for bytes or for silence, s: a wait of 0 would keep the processor busy."""


class Backoff:
    """Exponential backoff between connection attempts, up to `LONGEST_PAUSE_S`; `reason` is the last error."""

    def __init__(self) -> None:
        self.reason: Exception = ConnectionError("not tried yet")
        self._pause_s = 0.0
        self._not_before_s = 0.0

    def wait_s(self, now_s: float) -> float:
        """Return the time until the next attempt is allowed, s."""
        return max(self._not_before_s - now_s, 0.0)

    def failed(self, now_s: float, reason: Exception) -> None:
        """Double the pause after a failed attempt."""
        self._pause_s = min(max(2.0 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
        self._not_before_s = now_s + self._pause_s
        self.reason = reason

    def succeeded(self) -> None:
        """Reset the pause after a connection."""
        self._pause_s = 0.0

    def forgive(self) -> None:
        """Allow the next attempt at once."""
        self._not_before_s = 0.0


CHECK_LINE: Final = "Check that the device is on, its address and port, and that no other client holds it."
REPEAT: Final = "Check the line and the device's documentation; the request may be repeated."
_CHECK_GROUP: Final = "Add the user to the group that owns the port, often dialout."
_CHECK_OTHERS: Final = "End the other program, or use another port."


class GarbledAnswerError(LinkError):
    """The device sent bytes that are not a valid response to the request."""


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
    TimeoutError: (DeviceTimeoutError, "did not accept a connection within {timeout_s:g} s", CHECK_LINE),
    ConnectionRefusedError: (LinkError, "refused the connection", CHECK_LINE),
    ConnectionResetError: (LinkError, "closed the connection", CHECK_LINE),
    OSError: (LinkError, "cannot be reached: {error}", CHECK_LINE),
    Exception: (LinkError, "failed: {error}", REPEAT),
}
"""Error of the port by exception class; the first match is used."""


def link_error(error: Exception, device: str, timeout_s: float) -> DriverError:
    """Map an exception of a socket or a serial port to an error of the port."""
    by_class = next(row for kind, row in _BY_CLASS.items() if isinstance(error, kind))
    row = _SERIAL.get(error.errno or 0, by_class) if isinstance(error, SerialException) else by_class
    return error_of(row, error, device, timeout_s)


def error_of(row: Row, error: Exception, device: str, timeout_s: float) -> DriverError:
    """Build the error that a row of a table describes."""
    kind, message, remedy = row
    return kind(f"{device} {message.format(error=error, timeout_s=timeout_s)}", remedy=remedy)


def put_off(why: DriverError, wait_s: float) -> LinkError:
    """Return the error of a call during the backoff: why the last attempt failed, and when the next one is due."""
    return LinkError(f"{why.message}; the next attempt is due in {wait_s:.1f} s", remedy=why.remedy)
