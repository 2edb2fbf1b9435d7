"""Outcome of the reproduction of each printed figure: one mark for each figure, with the reason.

    remade              the same digits come out of the computation that the thesis describes
    arithmetic          the same digits follow from other printed figures
    misprint            the figure contradicts the text or other printed figures; `right` is what it should read
    not reproducible    everything needed is stated, or was tried, and the figure does not come out
    not stated          what the figure was computed from is not stated; nothing contradicts it

Invariant: a printed figure counts as agreeing when ours gives its digits rounded or cut off, because the thesis
does both, or when some amplitude and period that round to the stated ones give it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from autotuner_models.report import Column, ReportTable

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


class Mark(StrEnum):
    """Outcome of a printed figure."""

    REMADE = "remade"
    ARITHMETIC = "arithmetic"
    MISPRINT = "misprint"
    NOT_REPRODUCIBLE = "not reproducible"
    NOT_STATED = "not stated"
    DIFFERS = "differs"
    """A figure that should agree and does not: a failure of this program."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One printed figure.

    Attributes
    ----------
    table, row, name : str
        Number of the table, its row, and which figure of it.
    printed : str
        The figure as printed.
    mark : Mark
        What became of it.
    ours : float, optional
        Our result.
    right : str, optional
        Correct value of a misprint.
    note : str
        Reason, and attempts.
    """

    table: str
    row: str
    name: str
    printed: str
    mark: Mark
    ours: float | None = None
    right: str | None = None
    note: str = ""


def half_digit(printed: str) -> float:
    """Return half a unit of the last digit printed."""
    return 0.5 * 10.0 ** -len(printed.partition(".")[2])


def agrees(printed: str, ours: float, least: float | None = None, greatest: float | None = None) -> bool:
    """Return whether a printed figure is ours, rounded or cut off to its digits.

    Parameters
    ----------
    printed : str
        The figure.
    ours : float
        Our figure.
    least, greatest : float, optional
        What ours can be within the digits of the amplitude and period that it came from.
    """
    half = half_digit(printed)
    slack = 1e-9 * abs(ours)
    if -half - slack <= ours - float(printed) < 2.0 * half + slack:
        return True
    return least is not None and greatest is not None and least - half <= float(printed) <= greatest + half


def marks_table(key: str, title: str, figures: Sequence[Figure], note: str = "") -> ReportTable:
    """Return the figures as a table; those that differ are its failures."""
    return ReportTable(
        key,
        title,
        (
            Column("table", "table"),
            Column("row", "row"),
            Column("figure", "figure"),
            Column("printed", "printed"),
            Column("ours", "ours", ".6g"),
            Column("mark", "mark"),
            Column("right", "should read"),
            Column("note", "why, and what was tried"),
        ),
        tuple((f.table, f.row, f.name, f.printed, f.ours, f.mark.value, f.right, f.note) for f in figures),
        note=note,
        failures=tuple(
            f"table {f.table}, {f.row}: {f.name} is {f.ours}, printed {f.printed}"
            for f in figures
            if f.mark is Mark.DIFFERS
        ),
    )


def summary_table(figures: Iterable[Figure]) -> ReportTable:
    """Return how many figures of each table have which mark."""
    counts: dict[str, Counter[Mark]] = {}
    for figure in figures:
        counts.setdefault(figure.table, Counter())[figure.mark] += 1
    marks = [mark for mark in Mark if mark is not Mark.DIFFERS]
    rows = [(table, *(str(count[mark]) for mark in marks), str(count.total())) for table, count in counts.items()]
    total = sum(counts.values(), Counter())
    rows.append(("all", *(str(total[mark]) for mark in marks), str(total.total())))
    return ReportTable(
        "summary",
        "What became of each printed figure",
        (Column("table", "table"), *(Column(mark.name.lower(), mark.value) for mark in marks), Column("all", "all")),
        tuple(rows),
    )
