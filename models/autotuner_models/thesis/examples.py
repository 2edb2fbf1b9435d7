"""Examples 1 to 6 of the thesis, tables 5.2 to 5.7: its "Offline" and learned rows as printed, and ours."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner_models.report import Column, ReportTable, percent_off
from autotuner_models.shipped import provider
from autotuner_models.thesis.data_sets import Plants
from autotuner_models.thesis.ours import estimates
from autotuner_models.thesis.printed import OFFLINE, PROPOSED, TABLES

if TYPE_CHECKING:
    from autotuner_models.report import Cell
    from autotuner_models.thesis.printed import ThesisTable

FIRST = 3
"""Tables before the examples."""


def examples_table() -> ReportTable:
    """Return printed and our estimates with their errors; a parameter further off than the thesis's is a failure."""
    rows: list[tuple[Cell, ...]] = []
    failures = []
    models = provider()
    for number, table in enumerate(TABLES[FIRST:], start=1):
        values, _ = estimates(models, table.structure, _plants(table.truth), math.inf)
        for i, name in enumerate(_targets(table)):
            truth, offline, learned = table.truth[name], _printed(table, OFFLINE, name), _printed(table, PROPOSED, name)
            ours = float(values[0, i])
            rows.append(
                (
                    str(number),
                    name,
                    truth,
                    offline,
                    learned,
                    ours,
                    *(percent_off(v, truth) for v in (offline, learned, ours)),
                )
            )
            # printed figures are rounded: ours is held to the same digits
            figure = table.row(PROPOSED).printed[name]
            digits = len(figure.partition(".")[2])
            if not abs(round(ours, digits) - truth) <= abs(learned - truth) + 1e-9:
                failures.append(
                    f"example {number}: {name} is {ours:.5g}, the thesis's {learned:g}, the truth {truth:g}"
                )
    return ReportTable(
        "examples",
        "Examples 1 to 6: as printed, and the shipped correction on sampled records",
        (
            Column("example", "example"),
            Column("figure", "figure"),
            Column("truth", "truth", "g"),
            Column("offline", "Offline", ".5g"),
            Column("thesis_ml", "Thesis ML", ".5g"),
            Column("ours", "ours", ".6g"),
            Column("offline_error", "error %", "+.3g"),
            Column("thesis_ml_error", "error %", "+.3g"),
            Column("ours_error", "error %", "+.2g"),
        ),
        tuple(rows),
        note="Gain given to all, the dead time of second order to the thesis's rows alone.",
        failures=tuple(failures),
    )


def _targets(table: ThesisTable) -> tuple[str, str]:
    names = [name for name in table.truth if name != "K" and (name != "D" or table.structure == "fopdt")]
    return names[0], names[1]


def _plants(truth: object) -> Plants:
    assert isinstance(truth, dict)  # noqa: S101 - as the tables are written
    one = np.ones(1)
    if "T" in truth:
        return Plants(one * truth["K"], one * truth["D"], one * 0.0, one * truth["T"])
    m, n = (truth["m"], truth["n"]) if "m" in truth else (truth["T1"] * truth["T2"], truth["T1"] + truth["T2"])
    return Plants(one * truth["K"], one * truth["D"], one * m, one * n)


def _printed(table: ThesisTable, method: str, name: str) -> float:
    """Return a printed figure, a misprint as it should read."""
    row = table.row(method)
    misprint = row.misprint(name)
    return float(row.printed[name] if misprint is None else misprint.right)
