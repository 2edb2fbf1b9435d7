"""The log of the service: lines for people, or JSON objects for programs (`service.log`).

    {"at": "2026-01-01T12:00:00.123+00:00", "level": "INFO", "logger": "autotuner.runtime.event_log",
     "message": "..", "tuning": "3f2a..", "loop": "TIC-101", "t_s": 12.3}

Rules of this file:

1. What a line is about (`ABOUT`) is a field of its own, so that the lines of one tuning are found.
2. Lines are written by a thread of their own, as many at a time as gather in `GATHERED_S`: a thread that wakes for each
   of them wants the interpreter's lock two hundred times a second, just when a sample is due.
"""

from __future__ import annotations

import json
import logging
import threading
from datetime import UTC, datetime
from logging.handlers import QueueListener
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from queue import SimpleQueue

ABOUT = ("tuning", "loop", "t_s")
TEXT = "%(asctime)s %(levelname)s %(message)s"
GATHERED_S = 0.1
"""Longest time from an event to its line, s."""


class JsonLines(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        told: dict[str, object] = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        told |= {name: getattr(record, name) for name in ABOUT if hasattr(record, name)}
        if record.exc_info:
            told["trace"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


def formatter(kind: str) -> logging.Formatter:
    """Return what makes a line of a record; `kind` is ``text`` or ``json``."""
    return JsonLines() if kind == "json" else logging.Formatter(TEXT)


class Writer(QueueListener):
    """Writes the records of a queue in a thread of its own.

    Parameters
    ----------
    records : SimpleQueue
        What is to be written; None ends it.
    printer : Handler
        Writes.
    """

    def __init__(self, records: SimpleQueue[logging.LogRecord], printer: logging.Handler) -> None:
        super().__init__(records, printer)
        self._records = records
        self._ending = threading.Event()

    def dequeue(self, block: bool) -> logging.LogRecord:  # noqa: FBT001 - the library calls it so
        """Return the next record; where there was none, after more have gathered."""
        first = self._records.empty()
        record = self._records.get(block)
        if first and getattr(record, "levelno", logging.WARNING) < logging.WARNING:
            self._ending.wait(GATHERED_S)
        return record

    def stop(self) -> None:
        """Write what is left, and end."""
        self._ending.set()
        super().stop()
