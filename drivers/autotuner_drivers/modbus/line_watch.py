"""When a line whose answers carry no number may be used again.

On a serial line nothing ties an answer to its request. After a request that got no answer, the answer may still be on
its way, and would be taken for the answer to the next request of the same shape. So:

1. A request that was not answered owes the line an answer of known length. Until as many bytes have come, followed by a
   silence of `gap_s`, or until `patience_s` after the request, nothing is sent.
2. An answer's worth of bytes followed by silence, and yet no valid answer, is garbled: waiting longer is of no use.
3. A two-wire adapter may send back what is sent. With `echo` those bytes are taken off, once; whatever does not equal
   them is left alone, and fails by its checksum.

Invariants: pure; time is an argument, s on any scale that does not run backward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LineSettings:
    """Timing of a line.

    Attributes
    ----------
    patience_s : float
        Longest time from a request to an answer that may still arrive: the time limit of the answer and what
        it may be late.
    gap_s : float
        Silence that ends a message.
    pause_s : float
        Silence that a device needs between an answer and the next request.
    echo : bool
        Whether the line sends back what is sent.
    text : bool
        Whether messages are Modbus ASCII, two characters a byte, and not RTU.
    """

    patience_s: float
    gap_s: float = 0.05
    pause_s: float = 0.005
    echo: bool = False
    text: bool = False

    def size(self, rtu_bytes: int) -> int:
        """Return the length of a message on this line: ASCII has a colon, a checksum of one byte, CR and LF."""
        return 2 * (rtu_bytes - 1) + 3 if self.text else rtu_bytes


class LineWatch:
    """Keeps account of one line."""

    def __init__(self, settings: LineSettings) -> None:
        self.settings = settings
        self._expected = 0
        self._pending_bytes = 0
        self._received_bytes = 0
        self._buffer = b""
        self._packet = b""
        self._received_at_s = -math.inf
        self._give_up_s = -math.inf
        self._ready_s = -math.inf

    def expect(self, size: int) -> None:
        """Take note of the length of the next answer, bytes."""
        self._expected = size

    def sent(self, packet: bytes, now_s: float) -> None:
        """Take note of a request."""
        self._packet, self._buffer = packet, b""
        self._pending_bytes = self._expected + (len(packet) if self.settings.echo else 0)
        self._received_bytes = 0
        self._give_up_s = now_s + self.settings.patience_s

    def received(self, buffer: bytes, now_s: float) -> bytes:
        """Take note of what the line's buffer holds now; return it without the echo."""
        grown = buffer.startswith(self._buffer)
        self._received_bytes += len(buffer) - (len(self._buffer) if grown else 0)
        self._buffer, self._received_at_s = buffer, now_s
        return strip_echo(buffer, self._packet) if self.settings.echo else buffer

    def answered(self, now_s: float) -> None:
        """Take note that the answer has come."""
        self._pending_bytes = 0
        self._ready_s = now_s + self.settings.pause_s

    def garbled(self, now_s: float) -> bool:
        """Return whether an answer's worth of bytes has come and gone without having been one."""
        complete = 0 < self._pending_bytes <= self._received_bytes
        return complete and now_s >= self._received_at_s + self.settings.gap_s

    @property
    def answering(self) -> bool:
        """Whether the device has sent anything since the last request: it does so only when it understood."""
        return self._received_bytes > (len(self._packet) if self.settings.echo else 0)

    def ready_s(self) -> float:
        """Return the time from which a request may be sent, by what is known now."""
        silent_s = self._received_at_s + self.settings.gap_s
        if not self._pending_bytes:
            return self._ready_s
        return silent_s if self._received_bytes >= self._pending_bytes else max(self._give_up_s, silent_s)


def strip_echo(buffer: bytes, packet: bytes) -> bytes:
    """Return what follows the echo of `packet`; nothing while the echo is still coming in."""
    if buffer.startswith(packet):
        return buffer[len(packet) :]
    return b"" if packet.startswith(buffer) else buffer
