"""Processors that do not sleep between two samples: the quality-of-service request of Linux, held while it is needed.

    /dev/cpu_dma_latency    holds 0 us  ->  an idle processor waits instead of halting

A processor that has halted is woken by an interrupt, and under a virtual machine only when the machine below has one
free: that took milliseconds where others wanted it too. `cyclictest` asks for the same. It costs power, so it is asked
for only while a tuning runs in a service that is in the real-time class.

Rule of this file: the request ends with the file that holds it, and so with the process, however that ends.
"""

from __future__ import annotations

import logging
import os
import struct
from pathlib import Path

LATENCY = Path("/dev/cpu_dma_latency")

_log = logging.getLogger(__name__)


class Wakefulness:
    """The request of this process."""

    def __init__(self) -> None:
        self._file: int | None = None
        self._refused = False

    def ask(self) -> None:
        """Ask for processors that stay awake; may be repeated. Where that is not permitted the log says so, once."""
        if self._file is not None or self._refused:
            return
        try:
            file = os.open(LATENCY, os.O_WRONLY)
        except OSError as error:
            self._refused = True
            _log.warning(
                "processors may sleep between samples: %s: %s; let the service write it", LATENCY, error.strerror
            )
            return
        os.write(file, struct.pack("=i", 0))
        self._file = file

    def withdraw(self) -> None:
        """Let them sleep again; may be repeated."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
