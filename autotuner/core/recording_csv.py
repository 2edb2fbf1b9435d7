"""The CSV form of a recording: text <-> columns, nothing else.

The first line names the columns: `t,u,y` and optionally `sp` and `t_u`; other common names are accepted (`SYNONYMS`),
in any case, with a unit in brackets or without. Time is in seconds, or an ISO 8601 stamp. An empty `sp` cell means open
loop. `t_u` is the time from which `u` acts where it is not `t`, in seconds like it; an empty cell means `t`. Any other
column of numbers is kept under its own name.

Rules of this file: a cell that cannot be used is named by line, column and content; a row without PV or output is
dropped with a note; a repeated row is merged with a note; time that runs backward is an error, because no repair is
safe.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.arrays import FloatArray

SYNONYMS: dict[str, tuple[str, ...]] = {
    "t": ("t", "time", "t_s", "time_s", "timestamp", "seconds", "sec"),
    "output": ("u", "output", "op", "co", "mv", "op_pct", "out"),
    "pv": ("y", "pv", "process_variable", "measurement"),
    "set_point": ("sp", "set_point", "setpoint"),
    "written": ("t_u", "written_s"),
}
"""Accepted column names, in lower case and without units, by what they mean."""

REQUIRED = ("t", "output", "pv")
MAX_ROWS = 20_000_000


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
        Empty text, missing column, a cell that is no number, too few rows; names line, column and content.
    """
    header, rows = _read_rows(text, name)
    roles = {**_roles(header), **_chosen_roles(header, columns or {}, name)}
    _require_roles(roles, header, name)
    cells = {role: [row[i] for _, row in rows] for role, i in roles.items()}
    lines = [line for line, _ in rows]
    t = _times(cells["t"], lines, name, header[roles["t"]])
    values = {
        role: _numbers(column, lines, name, header[roles[role]], optional=True)
        for role, column in cells.items()
        if role != "t"
    }
    extra = _extra_columns(header, rows, set(roles.values()))
    return _clean(t, values, extra, name)


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


def _read_rows(text: str, name: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    if not text.strip():
        raise RecordingError("is empty", field=name, remedy="Give a CSV with the header t,u,y and one line a sample.")
    delimiter = ";" if text.split("\n", 1)[0].count(";") > text.split("\n", 1)[0].count(",") else ","
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    header, rows = [cell.strip() for cell in lines[0][1]], lines[1:]
    if all(_is_number(cell, optional=False) for cell in header):  # no header: columns go by their numbers
        header, rows = [str(i + 1) for i in range(len(header))], lines
    for line, row in rows:
        if len(row) < len(header):
            raise RecordingError(
                f"has {len(row)} cells where the header has {len(header)}",
                field=f"{name}, line {line}",
                remedy="Complete the line or remove it.",
            )
    if len(rows) < 2:
        raise RecordingError("needs two samples at least", field=name, value=len(rows), remedy="Record for longer.")
    if len(rows) > MAX_ROWS:
        raise RecordingError(
            f"has more than {MAX_ROWS} rows", field=name, value=len(rows), remedy="Thin it out or give a part of it."
        )
    return header, rows


def _roles(header: list[str]) -> dict[str, int]:
    plain = [re.sub(r"\s*[\[(].*?[\])]\s*$", "", cell).strip().lower().replace(" ", "_") for cell in header]
    return {
        role: next(i for i, cell in enumerate(plain) if cell in accepted)
        for role, accepted in SYNONYMS.items()
        if any(cell in accepted for cell in plain)
    }


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


def _require_roles(roles: Mapping[str, int], header: list[str], name: str) -> None:
    for role in REQUIRED:
        if role not in roles:
            raise RecordingError(
                f"has no column for {role}",
                field=f"{name}, line 1",
                value=",".join(header),
                remedy=f"Name one column {' or '.join(SYNONYMS[role])}, or say which one it is.",
            )


def _numbers(cells: list[str], lines: list[int], name: str, column: str, *, optional: bool) -> FloatArray:
    try:
        return np.array([float(cell) if cell.strip() else np.nan for cell in cells], dtype=np.float64)
    except ValueError:
        line, cell = next(
            (line, cell) for line, cell in zip(lines, cells, strict=True) if not _is_number(cell, optional=optional)
        )
        raise RecordingError(
            "is not a number",
            field=f"{name}, line {line}, column {column}",
            value=cell,
            remedy="Write numbers with a decimal point and without units.",
        ) from None


def _is_number(cell: str, *, optional: bool = True) -> bool:
    try:
        float(cell)
    except ValueError:
        return optional and not cell.strip()
    return True


def _times(cells: list[str], lines: list[int], name: str, column: str) -> FloatArray:
    if _is_number(cells[0], optional=False):
        times = _numbers(cells, lines, name, column, optional=False)
    else:
        stamps = [_stamp(cell, line, name, column) for cell, line in zip(cells, lines, strict=True)]
        _refuse_mixed_zones(stamps, name, column)
        times = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps], dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(times))
    if bad.size:
        raise RecordingError(
            "has no usable time",
            field=f"{name}, line {lines[int(bad[0])]}, column {column}",
            value=cells[int(bad[0])],
            remedy="Give every sample its time in seconds.",
        )
    return times


def _stamp(cell: str, line: int, name: str, column: str) -> datetime:
    try:
        return datetime.fromisoformat(cell.strip())
    except ValueError:
        raise RecordingError(
            "is neither seconds nor an ISO 8601 time",
            field=f"{name}, line {line}, column {column}",
            value=cell,
            remedy="Write 12.5 or 2026-01-31T12:00:00.5+01:00.",
        ) from None


def _refuse_mixed_zones(stamps: list[datetime], name: str, column: str) -> None:
    if len({stamp.tzinfo is None for stamp in stamps}) > 1:
        raise RecordingError(
            "mixes times with and without a time zone",
            field=f"{name}, column {column}",
            remedy="Write all times with their offset, or none.",
        )


def _extra_columns(header: list[str], rows: list[tuple[int, list[str]]], taken: set[int]) -> dict[str, FloatArray]:
    extra = {}
    for i, title in enumerate(header):
        cells = [row[i] for _, row in rows]
        if i not in taken and title and all(_is_number(cell) for cell in cells):
            extra[title] = np.array([float(cell) if cell.strip() else np.nan for cell in cells], dtype=np.float64)
    return extra


def _clean(t: FloatArray, columns: dict[str, FloatArray], extra: dict[str, FloatArray], name: str) -> Table:
    """Drop rows without PV or output and rows repeated word for word, and say so."""
    notes = []
    usable = np.isfinite(columns["output"]) & np.isfinite(columns["pv"])
    if dropped := int((~usable).sum()):
        notes.append(f"{name}: {dropped} rows without a usable output or PV were left out")
    same = np.zeros(t.size, dtype=bool)
    same[1:] = (np.diff(t) == 0.0) & (np.diff(columns["pv"]) == 0.0) & (np.diff(columns["output"]) == 0.0)
    if repeated := int((same & usable).sum()):
        notes.append(f"{name}: {repeated} repeated rows were merged")
    keep = usable & ~same
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
