"""The CSV form of a recording: text <-> columns, nothing else.

The first line names the columns: `t,u,y` and optionally `sp` and `t_u`; other common names are accepted (`SYNONYMS`),
in any case, with a unit in brackets or without. Time is in seconds, in the unit of its title (`t [min]`), or an ISO
8601 stamp. An empty `sp` cell means open loop. `t_u` is the time from which `u` acts where it is not `t`, in its unit;
an empty cell means `t`. Any other column of numbers is kept under its own name.

Rules of this file: a cell that cannot be used is named by line, column and content; a row without PV or output is
dropped with a note; a repeated row is merged with a note; where the output moves while the PV is missing, only the
longest part without such a hole is kept, with a note; time that runs backward is an error, because no repair is safe.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.csv_cells import Column, unit_of
from autotuner.core.csv_holes import longest_part
from autotuner.core.csv_long import read_block, read_head
from autotuner.core.csv_text import is_number, read_sheet
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.arrays import FloatArray
    from autotuner.core.csv_text import Sheet

SYNONYMS: dict[str, tuple[str, ...]] = {
    "t": ("t", "time", "timestamp", "seconds", "sec", "date_time", "datetime"),
    "output": ("u", "output", "op", "co", "mv", "op_pct", "out"),
    "pv": ("y", "pv", "process_variable", "measurement"),
    "set_point": ("sp", "set_point", "setpoint"),
    "written": ("t_u", "written", "written_s"),
}
"""Accepted column names, in lower case and without units, by what they mean."""

REQUIRED = ("t", "output", "pv")
TIMED = ("t", "written")
FEWEST_ROWS = 2
LATEST_S = 1e11
"""Seconds since 1970 that no recording reaches, the year 5138: what is later counts something shorter."""


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
                remedy=f"Name one column {' or '.join(SYNONYMS[role])}, or say which one it is."
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
        what = f"does not increase at sample {row}: {t[row - 1]:g} s is followed by {t[row]:g} s"
        raise column.error(row, what, "Sort the samples by time and drop repeated ones.")


def _clean(
    t: FloatArray, columns: dict[str, FloatArray], extra: dict[str, FloatArray], name: str, notes: list[str]
) -> Table:
    """Drop rows without PV or output, what lies behind a hole, and rows repeated word for word, and say so."""
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
