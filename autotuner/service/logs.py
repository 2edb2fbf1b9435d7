"""The log of the service: lines for people, or JSON objects for programs (`service.log`).

    {"at": "2026-01-01T12:00:00.123+00:00", "level": "INFO", "logger": "autotuner.runtime.event_log",
     "message": "..", "tuning": "3f2a..", "loop": "TIC-101", "t_s": 12.3}

Rule of this file: what a line is about (`ABOUT`) is a field of its own, so that the lines of one tuning are found.
"""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime

ABOUT = ("tuning", "loop", "t_s")
TEXT = "%(asctime)s %(levelname)s %(message)s"


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
