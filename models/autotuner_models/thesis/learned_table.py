"""Table 5.1 and ours: R2 on the thesis's protocol, off its grid, and out of its range.

`thesis's family` is the one that the thesis chose: a tree, and a line for the dead time of FOPDT. A tree answers with
values that it has seen, and an 80:20 split of a grid leaves every value in the training part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner_models.report import Column, ReportTable
from autotuner_models.thesis.data_sets import OFF_GRID, OUT_OF_RANGE
from autotuner_models.thesis.ours import ours_on
from autotuner_models.thesis.regressors import FAMILIES, errors_percent, other_rows, r2, trained

if TYPE_CHECKING:
    from autotuner_models.report import Cell


@dataclass(frozen=True, slots=True)
class Score:
    """One row of table 5.1: data set, target column, family chosen by the thesis, and the printed R2."""

    name: str
    column: int
    family: str
    printed: float


SCORES: tuple[Score, ...] = (
    Score("fopdt", 0, "tree", 0.991),
    Score("fopdt", 1, "linear", 0.997),
    Score("fopdt_noise", 0, "tree", 0.941),
    Score("fopdt_noise", 1, "linear", 0.966),
    Score("overdamped", 0, "tree", 0.949),
    Score("overdamped", 1, "tree", 0.949),
    Score("underdamped", 0, "tree", 0.993),
    Score("underdamped", 1, "tree", 0.998),
)


def r2_table() -> ReportTable:
    """Return table 5.1: printed, ours by every family on the thesis's own protocol."""
    rows: list[tuple[Cell, ...]] = []
    failures = []
    for score in SCORES:
        scores = {family: trained(score.name, score.column, family).r2("test") for family in FAMILIES}
        target = other_rows(score.name, OFF_GRID).targets[score.column]
        rows.append((score.name, target, score.printed, score.family, *scores.values()))
        if max(scores.values()) < score.printed:
            failures.append(f"table 5.1: R2 of {target}, {score.name}, is {max(scores.values()):.4f} at best")
    return ReportTable(
        "r2",
        "Table 5.1 on the thesis's protocol: R2 on a fifth of its own grid",
        (
            Column("set", "data set"),
            Column("target", "target"),
            Column("printed", "printed", ".3f"),
            Column("family", "thesis's family"),
            *(Column(family, family, ".4f") for family in FAMILIES),
        ),
        tuple(rows),
        failures=tuple(failures),
    )


def honest_table() -> ReportTable:
    """Return the same models off the grid and out of range, with the describing function and ours."""
    rows: list[tuple[Cell, ...]] = []
    for score in SCORES:
        theirs = trained(score.name, score.column, score.family)
        for where in (OFF_GRID, OUT_OF_RANGE):
            others = other_rows(score.name, where)
            truth, start = others.Y[:, score.column], others.X[:, score.column - 2]
            best = max(FAMILIES, key=lambda family: trained(score.name, score.column, family).r2(where))
            ours, answered = ours_on(score.name, where)
            found = ours[:, score.column]
            rows.append(
                (
                    *(score.name, others.targets[score.column], where.replace("_", " ")),
                    *(theirs.r2("test"), theirs.r2(where), trained(score.name, score.column, best).r2(where), best),
                    *(r2(truth, start), r2(truth[answered], found[answered])),
                    *(float(np.median(errors_percent(truth, values))) for values in (start, theirs.predicted[where])),
                    float(np.median(errors_percent(truth, found)[answered])),
                    float(np.quantile(errors_percent(truth, found)[answered], 0.95)),
                    100.0 * float(answered.mean()),
                )
            )
    return ReportTable(
        "off_grid",
        "The same models off the grid and out of range: R2, and errors in %",
        (
            Column("set", "data set"),
            Column("target", "target"),
            Column("where", "plants"),
            Column("r2_grid", "R2 on the grid", ".4f"),
            Column("r2", "R2 here", ".4f"),
            Column("r2_best", "best family", ".4f"),
            Column("best", "which"),
            Column("r2_df", "DF", ".4f"),
            Column("r2_ours", "ours", ".6f"),
            Column("median_df", "median %: DF", ".3g"),
            Column("median_theirs", "thesis's", ".3g"),
            Column("median_ours", "ours", ".3g"),
            Column("p95_ours", "p95, ours", ".3g"),
            Column("answered", "ours answers %", ".1f"),
        ),
        tuple(rows),
        note="Ours is the shipped correction on sampled records of the same plants, gain given, dead time NOT given.",
    )
