"""The log of the service: lines for people, or JSON objects for programs (`service.log`).

    {"at": "2026-01-01T12:00:00.123+00:00", "level": "INFO", "logger": "autotuner.control.reporting.event_log",
     "message": "..", "tuning": "3f2a..", "loop": "TIC-101", "t_s": 12.3}

Invariants:

1. The subjects of a line (`ABOUT`) are separate fields, so that the lines of one tuning can be found.
2. Lines that nobody reads are not gathered without end: at `MOST_WAITING` they are left out, and counted.
"""

from __future__ import annotations

import json
import logging
import math
import threading
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from queue import SimpleQueue

_log = logging.getLogger(__name__)

ABOUT = ("tuning", "loop", "t_s")
TEXT = "%(asctime)s %(levelname)s %(message)s"
SOURCES = ("uvicorn.access", "uvicorn.error")
"""Loggers with a budget of their own; all others share one."""
ACCESS, ACCESS_FIELDS = SOURCES[0], 5
"""The log of requests: client, method, path, version, status."""
STATIC, FIRST_ERROR = "/page/", 400
"""Path of the files of the page, and the lowest status of an error."""
BYTES_PER_S = 4096.0
"""Budget of a source: 250 kB a minute, and 750 kB for all three."""
BURST_BYTES = 64 * 1024.0
"""Budget of a source at once."""
LINE_BYTES, TRACE_BYTES = 150, 4000
"""Approximate size of a line besides its message, and of a traceback, bytes."""
MOST_WAITING = 10_000
"""Records that wait for their line, at most: some megabytes."""


def worth_a_line(record: logging.LogRecord) -> bool:
    """Return whether a record is logged: served files of the page are not."""
    if record.name != ACCESS or not isinstance(record.args, tuple) or len(record.args) != ACCESS_FIELDS:
        return True
    path, status = str(record.args[2]), record.args[4]
    return not (path.startswith(STATIC) and isinstance(status, int) and status < FIRST_ERROR)


class LogBudget(logging.Filter):
    """Passes records as long as their source has a budget of bytes, which fills with time.

    Parameters
    ----------
    clock : callable
        Returns the time, s.
    records : SimpleQueue
        The queue of those that are not yet written.
    """

    def __init__(self, clock: Callable[[], float], records: SimpleQueue[logging.LogRecord]) -> None:
        super().__init__()
        self._clock, self._records = clock, records
        self._lock = threading.Lock()
        now_s = clock()
        self._sources = {source: _Source(now_s) for source in (*SOURCES, "")}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is written; before the first after others that were not, log how many were not."""
        name = next((source for source in SOURCES if record.name.startswith(source)), "")
        size: float = LINE_BYTES + len(record.getMessage()) + (TRACE_BYTES if record.exc_info else 0)
        if self._records.qsize() >= MOST_WAITING:
            size = math.inf
        with self._lock:
            left_out = self._sources[name].take(size, self._clock())
        if left_out:
            _log.warning("%d lines of %s were left out of the log", left_out, name or "the service")
        return left_out is not None


@dataclass(slots=True)
class _Source:
    """A source of records, and the rest of its budget."""

    then_s: float
    left: float = BURST_BYTES
    left_out: int = 0

    def take(self, size: float, now_s: float) -> int | None:
        """Take a record out of the budget; return how many were left out before it, None for one that is itself."""
        self.left = min(BURST_BYTES, self.left + (now_s - self.then_s) * BYTES_PER_S)
        self.then_s = now_s
        if size > self.left:
            self.left_out += 1
            return None
        self.left -= size
        left_out, self.left_out = self.left_out, 0
        return left_out


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        entry: dict[str, object] = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: getattr(record, name) for name in ABOUT if hasattr(record, name)}
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


def formatter(kind: str) -> logging.Formatter:
    """Return the formatter of a record; `kind` is ``text`` or ``json``."""
    return JsonLines() if kind == "json" else logging.Formatter(TEXT)
