"""The CSV form of a recording: text <-> columns, nothing else.

The first line names the columns: `t,u,y` and optionally `sp` and `t_u`; other common names are accepted (`SYNONYMS`),
in any case, with a unit in brackets or without. Time is in seconds, in the unit of its title (`t [min]`), or an ISO
8601 stamp. An empty `sp` cell means open loop. `t_u` is the time from which `u` acts where it is not `t`, in its unit;
an empty cell means `t`. Any other column of numbers is kept under its own name.

Invariants: a cell that cannot be used is named by line, column and content; a row without PV or output is
dropped with a note; a repeated row is merged with a note; where the output moves while the PV is missing, only the
longest part without such a hole is kept, with a note; time that runs backward is an error, because no repair is safe.

Decoding of a CSV file of any origin: from bytes to header and rows.

    encoding    UTF-8, UTF-16 with its mark, else the Windows code page 1252
    delimiter   comma, semicolon or tab: the most frequent one in the header
    header      the first line that is not a comment (`#`); a line of units below it is skipped with a note

Invariant: a file that is not a table of text is refused by its kind (a workbook, a page), not by its first odd byte.

Cells of a CSV recording as numbers: decimal points and commas, marks for no value, times in any unit or as stamps.

    t = cell * factor,   factor by the unit in the title: `t [min]`, `time (ms)`, `t_ms`; seconds where it names none

Invariant: a cell that cannot be read is named by line, column and content.

Long CSV recordings of plain numbers, read as a block: ten million rows in bounded time and memory.

Files with anything else (an empty cell, a stamp, a repeated or earlier time) are read cell by cell, with errors that
name the cell.

Rows without a PV: harmless while the output rests, a hole in the record where it moves.

    lost = sum |u_k - u_a| dt_k over the rows of a hole,   u_a the output of the last row with a PV
    a hole counts when   lost > 0.02 sum |u_k - median u| dt_k over the record

The output within such a gap is not known from its edges, so only one side of the gap can be used.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import FloatArray
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from autotuner.core.model.arrays import BoolArray, FloatArray

SYNONYMS: dict[str, tuple[str, ...]] = {
    "t": ("t", "time", "timestamp", "seconds", "sec", "date_time", "datetime"),
    "output": ("u", "output", "op", "co", "mv", "op_pct", "out"),
    "pv": ("y", "pv", "process_variable", "measurement"),
    "set_point": ("sp", "set_point", "setpoint"),
    "written": ("t_u", "written", "written_s"),
}
"""Accepted column names, in lower case and without units, by their role."""

REQUIRED = ("t", "output", "pv")
TIMED = ("t", "written")
FEWEST_ROWS = 2
"""Fewest rows of a table: an interval needs two."""
LATEST_S = 1e11
"""Seconds since 1970 of the year 5138: a larger number has a smaller unit."""


@dataclass(frozen=True, slots=True)
class Table:
    """The columns of a CSV recording."""

    t: FloatArray
    output: FloatArray
    pv: FloatArray
    set_point: FloatArray | None
    extra: Mapping[str, FloatArray]
    notes: tuple[str, ...]
    written_s: FloatArray | None = None


def parse_csv(text: str, name: str, columns: Mapping[str, str] | None = None) -> Table:
    """Return the columns of a CSV text.

    Parameters
    ----------
    text : str
        Header line and one line a sample; the header may be absent when `columns` gives numbers.
    name : str
        Name of the source, for messages.
    columns : mapping of str to str, optional
        Which column is `t`, `output`, `pv`, `set_point`, `written`: its title, or its number counted from 1.

    Raises
    ------
    RecordingError
        Empty text, missing column, a cell that is not a number, too few rows; names line, column and content.
    """
    long = _long(text, name, columns or {})
    if long is not None:
        return long
    sheet = read_sheet(text, name)
    roles = {**_roles(sheet.header), **_chosen_roles(sheet.header, columns or {}, name)}
    _require_roles(roles, sheet, name)
    if len(sheet.rows) < FEWEST_ROWS:
        raise RecordingError("needs two samples at least", field=name, value=len(sheet.rows), remedy="Record longer.")
    column = {role: _column(sheet, i, name) for role, i in roles.items()}
    t = column["t"].times()
    _require_forward(t, column["t"])
    values = {role: cells.numbers() for role, cells in column.items() if role not in TIMED}
    if "written" in column:
        own = unit_of(column["written"].title)
        unit = (column["t"] if own is None else column["written"]).unit_s
        values["written"] = column["written"].numbers() * unit
    notes = [*sheet.notes, *_unit_note(column["t"], name)]
    return _clean(t, values, _extra_columns(sheet, set(roles.values()), name), name, notes)


def _long(text: str, name: str, columns: Mapping[str, str]) -> Table | None:
    """Return the columns of a long text of plain numbers with times that increase; None for any other."""
    head = read_head(text, name)
    if head is None:
        return None
    roles = {**_roles(head.header), **_chosen_roles(head.header, columns, name)}
    _require_roles(roles, head, name)
    read = read_block(text, head)
    if read is None or not set(roles.values()) <= set(read[1]):
        return None
    block, kept = read
    values = {role: block[:, kept.index(i)] for role, i in roles.items()}
    title = _column(head, roles["t"], name)
    t, unit = values.pop("t") * title.unit_s, title.unit_s
    if not np.all(np.diff(t) > 0.0):
        return None
    if "written" in values:
        written = _column(head, roles["written"], name)
        values["written"] = values["written"] * (unit if unit_of(written.title) is None else written.unit_s)
    extra = {head.header[i]: block[:, k] for k, i in enumerate(kept) if i not in roles.values() and head.header[i]}
    return _clean(t, values, extra, name, [*head.notes, *_unit_note(title, name)])


def _unit_note(column: Column, name: str) -> list[str]:
    if column.unit_s == 1.0:
        return []
    return [f"{name}: the times of {column.title} were multiplied by {column.unit_s:g} to be seconds"]


def render_csv(
    t: FloatArray,
    output: FloatArray,
    pv: FloatArray,
    set_point: FloatArray | None,
    extra: Mapping[str, FloatArray],
    written_s: FloatArray | None = None,
) -> str:
    """Return CSV text that `parse_csv` reads back to the same numbers."""
    columns: dict[str, FloatArray] = {"t": t, "u": output, "y": pv}
    if set_point is not None:
        columns["sp"] = set_point
    if written_s is not None:
        columns["t_u"] = written_s
    columns.update(extra)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(
        ["" if value != value else repr(value) for value in row]  # noqa: PLR0124 - NaN is the one value unlike itself
        for row in zip(*(column.tolist() for column in columns.values()), strict=True)
    )
    return buffer.getvalue()


def _roles(header: list[str]) -> dict[str, int]:
    plain = [_plain(title) for title in header]
    return {
        role: next(i for i, cell in enumerate(plain) if cell in accepted)
        for role, accepted in SYNONYMS.items()
        if any(cell in accepted for cell in plain)
    }


def _plain(title: str) -> str:
    """Return a title in lower case, without its unit."""
    bare = re.sub(r"\s*[\[(].*?[\])]\s*$", "", title).strip().lower().replace(" ", "_")
    unit = unit_of(bare)
    return bare if unit is None else bare.removesuffix(f"_{unit}")


def _chosen_roles(header: list[str], columns: Mapping[str, str], name: str) -> dict[str, int]:
    titles = {**{str(i + 1): i for i in range(len(header))}, **{title: i for i, title in enumerate(header)}}
    roles = {}
    for role, title in columns.items():
        if role not in SYNONYMS or title not in titles:
            raise RecordingError(
                f"has no column {title!r} for {role}",
                field=f"{name}, line 1",
                value=",".join(header),
                remedy=f"Choose {', '.join(SYNONYMS)} by a title or number of this file.",
            )
        roles[role] = titles[title]
    return roles


def _require_roles(roles: Mapping[str, int], sheet: Sheet, name: str) -> None:
    for role in REQUIRED:
        if role not in roles:
            raise RecordingError(
                f"has no column for {role}" if sheet.titled else "has no titles in its first line",
                field=f"{name}, line 1",
                value=",".join(sheet.header if sheet.titled else sheet.rows[0][1]),
                remedy=f"Name one column {' or '.join(SYNONYMS[role])}, or select one."
                if sheet.titled
                else "Write t,u,y above the columns, or choose them by their numbers, counted from 1.",
            )


def _column(sheet: Sheet, i: int, name: str) -> Column:
    cells, lines = [row[i] for _, row in sheet.rows], [line for line, _ in sheet.rows]
    return Column(cells, lines, name, sheet.header[i], sheet.decimal_comma)


def _extra_columns(sheet: Sheet, taken: set[int], name: str) -> dict[str, FloatArray]:
    extra = {}
    for i, title in enumerate(sheet.header):
        column = _column(sheet, i, name)
        if i not in taken and title and all(is_number(cell) or not cell.strip() for cell in column.cells):
            extra[title] = column.numbers()
    return extra


def _require_forward(t: FloatArray, column: Column) -> None:
    backward = np.flatnonzero(np.diff(t) < 0.0)
    if backward.size:
        row = int(backward[0]) + 1
        message = f"does not increase at sample {row}: {t[row - 1]:g} s is followed by {t[row]:g} s"
        raise column.error(row, message, "Sort the samples by time and drop repeated ones.")


def _clean(
    t: FloatArray, columns: dict[str, FloatArray], extra: dict[str, FloatArray], name: str, notes: list[str]
) -> Table:
    """Drop rows without PV or output, the part after a gap, and repeated rows; each with a note."""
    if t[0] > LATEST_S:
        notes.append(f"{name}: the times begin at {t[0]:.4g} s: milliseconds since 1970 need the title t [ms]")
    usable = np.isfinite(columns["output"]) & np.isfinite(columns["pv"])
    if dropped := int((~usable).sum()):
        notes.append(f"{name}: {dropped} rows without a usable output or PV were left out")
    same = np.zeros(t.size, dtype=bool)
    same[1:] = (np.diff(t) == 0.0) & (np.diff(columns["pv"]) == 0.0) & (np.diff(columns["output"]) == 0.0)
    if repeated := int((same & usable).sum()):
        notes.append(f"{name}: {repeated} repeated rows were merged")
    part, holes = longest_part(t, columns["output"], usable)
    if holes:
        notes.append(
            f"{name}: the output moved while the PV was missing ({holes} stretches): only the part from "
            f"{t[part.start]:g} to {t[part.stop - 1]:g} s was used"
        )
    keep = usable & ~same
    keep[: part.start] = keep[part.stop :] = False
    _require_own_times(t[keep], name)
    set_point = columns.get("set_point")
    has_set_point = set_point is not None and bool(np.isfinite(set_point[keep]).any())
    return Table(
        t[keep],
        columns["output"][keep],
        columns["pv"][keep],
        set_point[keep] if set_point is not None and has_set_point else None,
        {title: values[keep] for title, values in extra.items()},
        tuple(notes),
        columns["written"][keep] if "written" in columns else None,
    )


def _require_own_times(t: FloatArray, name: str) -> None:
    """Refuse different samples of one time: they were rounded, and by how much is not known."""
    if shared := int(np.count_nonzero(np.diff(t) == 0.0)):
        raise RecordingError(
            f"has {shared} samples with the time of the one before but other values",
            field=name,
            value=float(t[1:][np.diff(t) == 0.0][0]),
            remedy="The times may have been rounded: export them with fractions of a second.",
        )


MAX_ROWS = 3_000_000
"""Lines that are read cell by cell at most: more of them would need gigabytes."""
DELIMITERS = (",", ";", "\t")
COMMENT = "#"
UTF_8_MARK = b"\xef\xbb\xbf"
MARKS = ((UTF_8_MARK, "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
SAVE_AS_CSV = "Save the file as CSV in UTF-8."
STRANGERS = (
    (b"PK\x03\x04", "is a workbook or archive, not CSV"),
    (b"\xd0\xcf\x11\xe0", "is a workbook, not CSV"),
    (b"%PDF", "is a PDF, not CSV"),
    (b"\x1f\x8b", "is compressed"),
    (b"\x89HDF", "is HDF5, not CSV"),
    (b"<", "is a page or XML, not CSV"),
    (b"{", "is JSON, not CSV"),
    (b"[{", "is JSON, not CSV"),
)
"""First bytes of common other formats."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """The cells of a CSV text.

    Attributes
    ----------
    header : list of str
        Titles; the numbers of the columns from 1 where the text has no header.
    rows : list of (int, list of str)
        Line number and cells of each sample.
    delimiter : str
        The character between cells.
    notes : tuple of str
        What was left out.
    titled : bool
        Whether the text has a header.
    """

    header: list[str]
    rows: list[tuple[int, list[str]]]
    delimiter: str
    notes: tuple[str, ...]
    titled: bool

    @property
    def decimal_comma(self) -> bool:
        """Whether a comma may stand for the decimal point."""
        return self.delimiter != ","


def decoded(content: bytes, name: str) -> str:
    """Return the text of a file.

    Raises
    ------
    RecordingError
        It is another kind of file, or no text.
    """
    for first, what in STRANGERS:
        if content.removeprefix(UTF_8_MARK).startswith(first):
            raise RecordingError(what, field=name, remedy=SAVE_AS_CSV)
    encoding = next((encoding for mark, encoding in MARKS if content.startswith(mark)), "utf-8")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        if b"\x00" in content or encoding == "utf-16":
            raise RecordingError(f"is not UTF-8 text (byte {error.start})", field=name, remedy=SAVE_AS_CSV) from error
    try:
        # Only titles hold such letters: numbers read the same in every code page.
        return content.decode("cp1252")
    except UnicodeDecodeError as error:
        raise RecordingError(f"is not UTF-8 text (byte {error.start})", field=name, remedy=SAVE_AS_CSV) from error


def read_sheet(text: str, name: str) -> Sheet:
    """Return header and rows of a CSV text.

    Raises
    ------
    RecordingError
        No text, a line shorter than the header, or too many lines.
    """
    if not text.strip():
        raise _empty(name)
    if (count := text.count("\n")) > MAX_ROWS:
        raise RecordingError(
            f"has more than {MAX_ROWS} lines, and not every cell is a plain number",
            field=name,
            value=count,
            remedy="Thin it out or give a part of it, or write plain numbers only.",
        )
    delimiter = _delimiter(text)
    lines = _lines(text, delimiter, name)
    if not lines:  # nothing but separators
        raise _empty(name)
    while len(lines) > 1 and lines[0][1][0].lstrip().startswith(COMMENT):
        lines.pop(0)
    header, rows = [cell.strip() for cell in lines[0][1]], lines[1:]
    titled = not all(is_number(cell) for cell in header)
    if not titled:
        header, rows = [str(i + 1) for i in range(len(header))], lines
    notes = []
    if titled and rows and _tells_units(rows[0][1]):
        notes.append(f"{name}: line {rows[0][0]} holds units and was left out")
        rows = rows[1:]
    _require_whole(header, rows, name)
    return Sheet(header, rows, delimiter, tuple(notes), titled)


def _empty(name: str) -> RecordingError:
    return RecordingError("is empty", field=name, remedy="Give a CSV with the header t,u,y and one line a sample.")


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _lines(text: str, delimiter: str, name: str) -> list[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=None), delimiter=delimiter)
    try:
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise RecordingError(
            f"is not CSV: {error}", field=f"{name}, line {reader.line_num}", remedy=SAVE_AS_CSV
        ) from error


def _delimiter(text: str) -> str:
    lines = (line for line in io.StringIO(text, newline=None) if line.strip() and not line.lstrip().startswith(COMMENT))
    return max(DELIMITERS, key=next(lines, "").count)


def _tells_units(row: list[str]) -> bool:
    """Return whether a line below the header holds words only, without any digit."""
    return any(cell.strip() for cell in row) and not any(character.isdigit() for cell in row for character in cell)


def _require_whole(header: list[str], rows: list[tuple[int, list[str]]], name: str) -> None:
    for line, row in rows:
        if len(row) < len(header):
            raise RecordingError(
                f"has {len(row)} cells where the header has {len(header)}",
                field=f"{name}, line {line}",
                remedy="Complete the line or remove it.",
            )


NO_VALUE = frozenset(
    {"", "bad", "bad input", "i/o timeout", "n/a", "#n/a", "na", "no data", "null", "none", "-", "--", "---", "invalid"}
)
"""Marks of historians for a missing value, in lower case; `nan` is a number."""
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
        """Return the numbers, NaN for missing values; raise `RecordingError` for an invalid cell."""
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
                f"gives the time in {unit!r}, which is not a known unit of time",
                field=f"{self.name}, column {self.title}",
                value=unit,
                remedy="Write the time in s, ms, min or h and name the unit in the title: t [s].",
            )
        return SECONDS[unit]

    def error(self, row: int, what: str, remedy: str) -> RecordingError:
        """Return the error of a cell."""
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
    """Return the unit in a title in lower case: of `t [min]`, `time (ms)`, or after the last `_`; None without one."""
    bracketed = re.search(r"[\[(]\s*(.*?)\s*[\])]\s*$", title)
    if bracketed:
        return bracketed[1].lower() or None
    ending = title.strip().lower().rpartition("_")
    return ending[2] if ending[1] and ending[2] in SECONDS else None


LONG = 50_000
"""Lines from which a text is read so."""
MOST_LINES = 50_000_000
"""Most lines of a text: a year at 1.6 samples a second; bounds the memory of a reader."""
HEAD = 20_000
"""Characters in which the header is searched."""


def read_head(text: str, name: str) -> Sheet | None:
    """Return header and first rows of a long text; None for one that is read cell by cell."""
    lines = text.count("\n")
    if lines < LONG:
        return None
    if lines > MOST_LINES:
        raise RecordingError(
            f"has more than {MOST_LINES} lines", field=name, value=lines, remedy="Thin it out or give a part of it."
        )
    end = text.rfind("\n", 0, HEAD)
    return read_sheet(text[:end], name) if end > 0 else None


def read_block(text: str, head: Sheet) -> tuple[FloatArray, list[int]] | None:
    """Return the columns that hold numbers, shape (N, C), and their indices; None where a cell is not a number."""
    if not head.rows:
        return None
    columns = [i for i in range(len(head.header)) if all(is_number(row[i]) for _, row in head.rows)]
    if not columns:
        return None
    try:
        block = np.loadtxt(
            _text_lines(text, head.rows[0][0]),
            dtype=np.float64,
            delimiter=head.delimiter,
            usecols=columns,
            comments=None,
            ndmin=2,
        )
    except ValueError:
        return None
    return (block, columns) if np.isfinite(block).all() else None


def _text_lines(text: str, first: int) -> Iterator[str]:
    """Yield the lines from a number on, counted from 1, one at a time."""
    position = 0
    for _ in range(first - 1):
        position = text.index("\n", position) + 1
    while position < len(text):
        end = text.find("\n", position)
        end = len(text) if end < 0 else end
        if end > position:
            yield text[position:end]
        position = end + 1


COUNTS = 0.02
"""Share of the PV's motion that must get lost between two samples to count as an event."""


def longest_part(t: FloatArray, output: FloatArray, measured: BoolArray) -> tuple[slice, int]:
    """Return the rows of the longest part without a hole that counts, and how many such holes there are.

    Parameters
    ----------
    t, output : array of float, shape (N,)
        Times, s, and the output; NaN where it is not known.
    measured : array of bool, shape (N,)
        Which rows have a PV and an output.
    """
    everything = slice(0, t.size)
    if measured.all() or not measured.any():
        return everything, 0
    dt = np.append(np.diff(t), 0.0)
    before = np.maximum.accumulate(np.where(measured, np.arange(t.size), int(np.argmax(measured))))
    output = np.where(np.isfinite(output), output, np.nan)
    deviation = np.where(np.isfinite(output) & ~measured, np.abs(output - output[before]) * dt, 0.0)
    deviation[: int(np.argmax(measured))] = 0.0
    travel = float(np.nansum(np.abs(output - np.nanmedian(output)) * dt))
    lost = np.bincount(before, weights=deviation, minlength=t.size)
    edges = np.flatnonzero(lost > COUNTS * travel)
    if not edges.size:
        return everything, 0
    starts, ends = np.concatenate(([0], edges + 1)), np.append(edges + 1, t.size)
    count = np.concatenate(([0], np.cumsum(measured)))
    longest = int(np.argmax(count[ends] - count[starts]))
    return slice(int(starts[longest]), int(ends[longest])), int(edges.size)
