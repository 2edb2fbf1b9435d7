"""Cells of a CSV recording as numbers: decimal points and commas, marks for no value, times in any unit or as stamps.

    t = cell * factor,   factor by the unit in the title: `t [min]`, `time (ms)`, `t_ms`; seconds where it names none

Rule of this file: a cell that cannot be read is named by line, column and content.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from autotuner.core.arrays import FloatArray  # noqa: TC001 - part of the public signature
from autotuner.core.csv_text import is_number
from autotuner.errors import RecordingError

NO_VALUE = frozenset(
    {"", "bad", "bad input", "i/o timeout", "n/a", "#n/a", "na", "no data", "null", "none", "-", "--", "---", "invalid"}
)
"""What historians write where there is no value, in lower case; `nan` is a number."""
SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}
"""Units of time in a title, in seconds."""
TIMES = "seconds or an ISO 8601 time"


@dataclass(frozen=True, slots=True)
class Column:
    """The cells of one column.

    Attributes
    ----------
    cells : list of str
        One a sample.
    lines : list of int
        Their line numbers.
    name, title : str
        Of the source and of the column, for messages.
    decimal_comma : bool
        Whether a comma may stand for the decimal point.
    """

    cells: list[str]
    lines: list[int]
    name: str
    title: str
    decimal_comma: bool = False

    def numbers(self) -> FloatArray:
        """Return the numbers, NaN where there is no value; raise `RecordingError` for what is none."""
        try:
            return np.array([float(cell) if cell.strip() else np.nan for cell in self.cells], dtype=np.float64)
        except ValueError:
            return np.array([self._number(row) for row in range(len(self.cells))], dtype=np.float64)

    def _number(self, row: int) -> float:
        cell = self.cells[row].strip()
        if cell.lower() in NO_VALUE:
            return float("nan")
        plain = cell.replace(",", ".") if self.decimal_comma and cell.count(",") == 1 and "." not in cell else cell
        if not is_number(plain):
            raise self.error(row, "is not a number", "Write numbers with a decimal point and without units.")
        return float(plain)

    def times(self) -> FloatArray:
        """Return times in s: from numbers by the title's unit, or from ISO 8601 stamps since the first of them."""
        if not self.stamped:
            times = self.numbers() * self.unit_s
        else:
            stamps = [self._stamp(row) for row in range(len(self.cells))]
            self._refuse_mixed_zones(stamps)
            times = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps], dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(times))
        if bad.size:
            raise self.error(int(bad[0]), "has no usable time", "Give every sample its time in seconds.")
        return times

    @property
    def stamped(self) -> bool:
        """Whether the cells are dates rather than numbers."""
        first = next((cell for cell in self.cells if cell.strip()), "")
        return not is_number(first.replace(",", ".") if self.decimal_comma else first)

    @property
    def unit_s(self) -> float:
        """The unit of the title, s; 1 where it names none, and for stamps."""
        unit = unit_of(self.title)
        if unit is None or self.stamped:
            return 1.0
        if unit not in SECONDS:
            raise RecordingError(
                f"gives the time in {unit!r}, which is no unit of time that is known here",
                field=f"{self.name}, column {self.title}",
                value=unit,
                remedy="Write the time in s, ms, min or h and say so in the title: t [s].",
            )
        return SECONDS[unit]

    def error(self, row: int, what: str, remedy: str) -> RecordingError:
        """Return what is wrong with a cell."""
        place = f"{self.name}, line {self.lines[row]}, column {self.title}"
        return RecordingError(what, field=place, value=self.cells[row], remedy=remedy)

    def _stamp(self, row: int) -> datetime:
        try:
            return datetime.fromisoformat(self.cells[row].strip())
        except ValueError:
            raise self.error(
                row, f"is neither {TIMES.replace(' or', ' nor')}", "Write 12.5 or 2026-01-31T12:00:00.5+01:00."
            ) from None

    def _refuse_mixed_zones(self, stamps: list[datetime]) -> None:
        if len({stamp.tzinfo is None for stamp in stamps}) > 1:
            raise RecordingError(
                "mixes times with and without a time zone",
                field=f"{self.name}, column {self.title}",
                remedy="Write all times with their offset, or none.",
            )


def unit_of(title: str) -> str | None:
    """Return the unit in a title in lower case: of `t [min]`, `time (ms)`, or behind the last `_`; None without one."""
    bracketed = re.search(r"[\[(]\s*(.*?)\s*[\])]\s*$", title)
    if bracketed:
        return bracketed[1].lower() or None
    ending = title.strip().lower().rpartition("_")
    return ending[2] if ending[1] and ending[2] in SECONDS else None
