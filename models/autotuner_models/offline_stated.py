"""The thesis's "Offline" rows from the amplitude and period that it states, figure by figure beside what it prints.

The thesis reads `A` as the peak of the wave for FOPDT and as its fundamental for SOPDT, as its numbers show. Tables 2.1
to 2.3 state neither amplitude nor period; `offline_exact` remakes them.
"""

from __future__ import annotations

import itertools

from autotuner_models.estimates import by_describing_function
from autotuner_models.report import Cell, Column, ReportTable
from autotuner_models.thesis_tables import OFFLINE, PROPOSED, TABLES, Row, ThesisTable

DIFFERS = "differs"

Line = tuple[Cell, ...]


def stated_table() -> ReportTable:
    """Return each printed figure beside ours from the stated amplitude and period."""
    lines = [line for table in TABLES for line in (*_figures(table), *_errors(table))]
    return ReportTable(
        "stated",
        "Offline rows of the thesis, from its stated A and Pu",
        (
            Column("table", "table"),
            Column("figure", "figure"),
            Column("truth", "truth"),
            Column("printed", "printed"),
            Column("right", "should read"),
            Column("ours", "ours", ".6g"),
            Column("status", "status"),
            Column("note", "note"),
        ),
        tuple(lines),
        note=(
            "`same digits`: rounded or cut off to the digits printed; `within the digits of A, Pu`: the printed figure "
            "follows from some A and Pu that round to the stated ones."
        ),
        failures=tuple(
            f"table {line[0]}: {line[1]} is {line[5]}, printed {line[3]}" for line in lines if line[6] == DIFFERS
        ),
    )


def _figures(table: ThesisTable) -> list[Line]:
    """Return the parameters of the Offline row."""
    row = table.row(OFFLINE)
    lines: list[Line] = []
    for name, printed in row.printed.items():
        if table.A is None or table.Pu is None:
            missing = "the thesis states no A and Pu for it"
            lines.append((table.number, name, table.truth[name], printed, None, None, "not stated", missing))
            continue
        A = table.misprint.right if table.misprint else table.A
        ours = _range(table, name, A, table.Pu)
        note = f"with A {A}: {table.misprint.why}" if table.misprint else ""
        lines.append(_line(table, row, name, printed, ours, note=note))
    return lines


def _errors(table: ThesisTable) -> list[Line]:
    """Return the errors of the thesis's own two rows beside those that the printed figures have."""
    lines: list[Line] = []
    for row in table.rows:
        if row.method not in {OFFLINE, PROPOSED}:
            continue
        for name, printed in row.errors.items():
            wrong = row.misprint(name)
            figure = float(wrong.right if wrong else row.printed[name])
            error = 100.0 * abs(figure / table.truth[name] - 1.0)
            lines.append(_line(table, row, f"error in {name}", printed, (error, error, error)))
    return lines


def _line(
    table: ThesisTable, row: Row, name: str, printed: str, ours: tuple[float, float, float], note: str = ""
) -> Line:
    wrong = row.misprint(name)
    agrees = agreement(wrong.right if wrong else printed, *ours)
    status = "misprint" if wrong and agrees else agrees or DIFFERS
    notes = "; ".join(part for part in (wrong.why if wrong else "", note) if part)
    title = name if row.method == OFFLINE else f"{row.method}: {name}"
    return (table.number, title, table.truth.get(name), printed, wrong.right if wrong else None, ours[0], status, notes)


def _range(table: ThesisTable, name: str, A: str, Pu: str) -> tuple[float, float, float]:
    """Return our figure on the stated `A` and `Pu`, and the least and greatest that their rounding allows."""

    def figure(A: float, Pu: float) -> float:
        return by_describing_function(table.structure, table.truth, A, Pu).parameters()[name]

    a, p = half_digit(A), half_digit(Pu)
    corners = [figure(float(A) + i * a, float(Pu) + j * p) for i, j in itertools.product((-1, 1), repeat=2)]
    return figure(float(A), float(Pu)), min(corners), max(corners)


def half_digit(printed: str) -> float:
    """Return half a unit of the last digit printed."""
    return 0.5 * 10.0 ** -len(printed.partition(".")[2])


def agreement(printed: str, ours: float, least: float, greatest: float) -> str | None:
    """Return how ours agrees with a printed figure, or None.

    Parameters
    ----------
    printed : str
        The figure, rounded or cut off to its digits.
    ours : float
        Our figure.
    least, greatest : float
        What ours can be within the digits of the amplitude and period that it came from.
    """
    half = half_digit(printed)
    slack = 1e-9 * abs(ours)
    if -half - slack <= ours - float(printed) < 2.0 * half + slack:
        return "same digits"
    if least - half <= float(printed) <= greatest + half:
        return "within the digits of A, Pu"
    return None
