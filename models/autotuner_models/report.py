"""Tables of results that print for people and dump for programs from the same cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

Cell = str | float | None


@dataclass(frozen=True, slots=True)
class Column:
    """A heading, the key under which programs find it, and the format of its numbers."""

    key: str
    heading: str
    form: str = ".5g"


def percent_off(value: float, truth: float) -> float:
    """Return a relative error in percent."""
    return 100.0 * (value / truth - 1.0)


@dataclass(frozen=True, slots=True)
class ReportTable:
    """One table of a report.

    Attributes
    ----------
    key : str
        Name for programs.
    title : str
        Name for people.
    columns : tuple of Column
        What the cells are.
    rows : tuple of tuple of Cell
        One cell a column; None where there is nothing to say.
    note : str
        How to read it.
    failures : tuple of str
        What of it is not as it must be, in sentences; empty when all is well.
    """

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    failures: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values: a list of objects under ``rows``."""
        keys = [column.key for column in self.columns]
        return {
            "title": self.title,
            "rows": [dict(zip(keys, row, strict=True)) for row in self.rows],
            "note": self.note,
            "failures": list(self.failures),
        }

    def to_rich(self) -> Table:
        """Return the table for a terminal."""
        from rich.table import Table  # noqa: PLC0415 - only printing for people needs it

        table = Table(title=self.title, title_justify="left", caption=self.note, caption_justify="left")
        for i, column in enumerate(self.columns):
            numeric = any(isinstance(row[i], float) for row in self.rows)
            table.add_column(column.heading, justify="right" if numeric else "left")
        for row in self.texts():
            table.add_row(*row)
        return table

    def texts(self) -> list[list[str]]:
        """Return the cells as they are printed."""
        return [[_text(cell, column.form) for cell, column in zip(row, self.columns, strict=True)] for row in self.rows]


def _text(cell: Cell, form: str) -> str:
    if cell is None:
        return ""
    return cell if isinstance(cell, str) else format(cell, form)
