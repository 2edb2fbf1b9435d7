"""The whole reproduction as one HTML file: every printed figure with its mark, the underlying tables, the pictures."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

from autotuner.reports.document import Grid, Picture, Section, Words, document
from autotuner_models.thesis.marks import Mark
from autotuner_models.thesis.pictures import drawings, png

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner_models.report import ReportTable
    from autotuner_models.thesis.marks import Figure
    from autotuner_models.thesis.pictures import Drawing

TITLE = "Machine Learning for Improved Autotune Identification Method, remade"
SOURCE = (
    "B. Kumar, M.Tech. thesis, Indian Institute of Technology Guwahati. Every figure that its tables print, beside "
    "what this program computes, and its figures drawn anew."
)
MEANING: dict[Mark, str] = {
    Mark.REMADE: "the computation of the thesis yields the same digits",
    Mark.ARITHMETIC: "the same digits follow from other printed figures",
    Mark.MISPRINT: "the figure contradicts the text or other printed figures",
    Mark.NOT_REPRODUCIBLE: "the inputs are stated, or were tried, and the figure is not reproduced",
    Mark.NOT_STATED: "the inputs of the figure are not stated",
}
TITLES: dict[str, str] = {
    "2.1": "FOPDT, K 1, T 10, D 2",
    "2.2": "overdamped SOPDT, K 1, T1 10, T2 1, D 2",
    "2.3": "underdamped SOPDT, K 1, m 9, n 2.4, D 1",
    "4.1": "training data, FOPDT",
    "4.2": "training data, FOPDT with noise",
    "4.3": "training data, overdamped SOPDT",
    "4.4": "training data, underdamped SOPDT",
    "5.1": "R2 scores",
    "5.2": "example 1, FOPDT, K 1.65, T 20, D 10",
    "5.3": "example 2, FOPDT, K 8.1, T 9.4, D 5.2",
    "5.4": "example 3, overdamped SOPDT, K 1, T1 10, T2 2, D 4",
    "5.5": "example 4, overdamped SOPDT, K 1.5, T1 7.5, T2 4.2, D 5",
    "5.6": "example 5, underdamped SOPDT, K 1, m 1, n 0.4, D 3",
    "5.7": "example 6, underdamped SOPDT, K 3.5, m 9.4, n 3.7, D 7",
}
"""Subjects of the thesis's tables."""
FIGURE_COLUMNS = ("row", "figure", "printed", "ours", "mark", "should read", "why")
"""Columns of the report on printed figures."""


def thesis_report(figures: Sequence[Figure], summary: ReportTable, tables: Sequence[ReportTable]) -> str:
    """Return the report as HTML.

    Parameters
    ----------
    figures : sequence of Figure
        Every printed figure with its mark.
    summary : ReportTable
        How many figures of each table have which mark.
    tables : sequence of ReportTable
        Underlying tables.
    """
    marks = [(mark.value, meaning) for mark, meaning in MEANING.items()]
    head = Section("Result for each figure", [Grid("marks", ("mark", "meaning"), marks), _grid(summary)])
    printed = [Section(f"Table {number}", [_figures(number, figures)]) for number in TITLES]
    behind = [Section(table.title, [_grid(table), *([Words(table.note)] if table.note else [])]) for table in tables]
    pictures = Section(
        "Figures", [Words("The thesis prints no data for its figures."), *(_picture(one) for one in drawings())]
    )
    return document(TITLE, SOURCE, [head, *printed, pictures, *behind])


def _figures(number: str, figures: Sequence[Figure]) -> Grid:
    return Grid(TITLES[number], FIGURE_COLUMNS, figure_rows(number, figures))


def figure_rows(number: str, figures: Sequence[Figure]) -> list[tuple[str, ...]]:
    """Return the printed figures of one table in `FIGURE_COLUMNS`, those of a row of the table together."""
    of_table = [f for f in figures if f.table == number]
    order = list(dict.fromkeys(f.row for f in of_table))
    return [
        (f.row, f.name, f.printed, "" if f.ours is None else f"{f.ours:.6g}", f.mark.value, f.right or "", f.note)
        for f in sorted(of_table, key=lambda f: order.index(f.row))
    ]


def _grid(table: ReportTable) -> Grid:
    return Grid(table.title, [column.heading for column in table.columns], table.texts())


def _picture(drawing: Drawing) -> Picture:
    data = base64.b64encode(png(drawing)).decode()
    caption = f"Figure {drawing.number}: {drawing.caption}"
    return Picture(f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">', caption)
