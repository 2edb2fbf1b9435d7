"""Lines of the log on standard error, from a thread of their own: nothing waits for whoever reads them.

Invariants:

1. Lines are written in batches of `GATHERED_S`: a thread that wakes for each line needs the interpreter's lock two
   hundred times a second, when samples are due.
2. A reader that takes nothing, as a supervisor that stands still, delays only the lines, and the end by `LAST_LINES_S`.
   The thread holds no lock while it writes, so the interpreter can end meanwhile.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from logging.handlers import QueueListener
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from queue import SimpleQueue

STANDARD_ERROR = 2
"""Descriptor of standard error, by POSIX."""
GATHERED_S = 0.1
"""Longest time from an event to its line, s."""
LAST_LINES_S = 2.0
"""Longest wait at the end for the lines that are not yet written, s; a pipe that is read takes them in milliseconds."""


class LineWriter(QueueListener):
    """Writes the records of a queue in its own thread.

    Parameters
    ----------
    records : SimpleQueue
        What is to be written; None ends it.
    formatter : Formatter
        Returns the line of a record.
    descriptor : int, optional
        The file; standard error without one.
    """

    def __init__(
        self, records: SimpleQueue[logging.LogRecord], formatter: logging.Formatter, descriptor: int | None = None
    ) -> None:
        super().__init__(records)
        self._records, self._formatter = records, formatter
        self._descriptor = _standard_error() if descriptor is None else descriptor
        self._ending = threading.Event()

    def dequeue(self, block: bool) -> logging.LogRecord:  # noqa: FBT001 - the library calls it so
        """Return the next record; where there was none, after more have gathered."""
        first = self._records.empty()
        record = self._records.get(block)
        if first and getattr(record, "levelno", logging.WARNING) < logging.WARNING:
            self._ending.wait(GATHERED_S)
        return record

    def handle(self, record: logging.LogRecord) -> None:
        """Write the line of a record, past the buffer of the stream: its lock would be held meanwhile."""
        try:
            text = self._formatter.format(record)
        except Exception as error:  # noqa: BLE001 - of whoever logged it; the lines behind it are written all the same
            text = f"{record.name}: {record.msg!r} cannot be formatted: {error}"
        line = f"{text}\n".encode(errors="replace")
        with contextlib.suppress(OSError):  # nobody reads it any more
            while line:
                line = line[os.write(self._descriptor, line) :]

    def stop(self) -> None:
        """Write the remaining lines, as long as they are read, and end."""
        self._ending.set()
        ending = threading.Thread(target=super().stop, name="log-end", daemon=True)
        ending.start()
        ending.join(LAST_LINES_S)


def _standard_error() -> int:
    """Return the file of standard error; that of the process, where a program has put another object in its place."""
    try:
        return sys.stderr.fileno()
    except OSError:
        return STANDARD_ERROR
