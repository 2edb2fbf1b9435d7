"""Results of the thesis's regressors for new draws of its data set: the thesis does not state the rows drawn.

Each draw trains the family that the thesis chose (`SCORES`) on its own grid by its own protocol and predicts the stated
`A` and `Pu` of examples 1 to 6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner_models.estimates import H, by_describing_function
from autotuner_models.thesis.learned_table import SCORES
from autotuner_models.thesis.marks import Figure, Mark, agrees
from autotuner_models.thesis.printed import PROPOSED, TABLES
from autotuner_models.thesis.regressors import trained

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from autotuner_models.thesis.learned_table import Score
    from autotuner_models.thesis.printed import ThesisTable

SEEDS = (1, 2, 3, 4, 5)
"""Draws of each data set."""
SET_OF = {"fopdt": "fopdt", "sopdt_overdamped": "overdamped", "sopdt_underdamped": "underdamped"}
"""Data set that a structure's examples are predicted from."""
PRINTED_TARGETS = {
    "fopdt": ("T", "D"),
    "fopdt_noise": ("T", "D"),
    "overdamped": ("T1", "T2"),
    "underdamped": ("m", "n"),
}


class Target(NamedTuple):
    """A figure of a "Proposed" row: number of its table and its name."""

    table: str
    name: str


def predicted() -> dict[tuple[str, str], tuple[float, ...]]:
    """Return the predictions of each draw for every parameter of the "Proposed" rows, by table and name."""
    found: dict[tuple[str, str], tuple[float, ...]] = {}
    for table in TABLES:
        if all(row.method != PROPOSED for row in table.rows):
            continue
        for score in SCORES:
            if score.name == SET_OF[table.structure]:
                name = PRINTED_TARGETS[score.name][score.column]
                row = _features(table)[None]
                found[table.number, name] = tuple(
                    float(trained(score.name, score.column, score.family, seed).regressor.predict(row)[0])
                    for seed in SEEDS
                )
    return found


def _features(table: ThesisTable) -> NDArray[np.float64]:
    """Return the features of an example as the thesis states them."""
    A, Pu = float(table.misprint.right if table.misprint else str(table.A)), float(str(table.Pu))
    model = by_describing_function(table.structure, table.truth, A, Pu).parameters()
    K, D = table.truth["K"], table.truth["D"]
    if table.structure == "fopdt":
        return np.array([H, K, A, Pu, model["T"], model["D"]])
    first, second = PRINTED_TARGETS[SET_OF[table.structure]]
    return np.array([H, K, D, A, Pu, model[first], model[second]])


def score_figures() -> list[Figure]:
    """Return the scores of table 5.1 with their marks."""
    return [_score(score) for score in SCORES]


def _score(score: Score) -> Figure:
    scores = [trained(score.name, score.column, score.family, seed).r2("test") for seed in SEEDS]
    low, high = min(scores), max(scores)
    printed = f"{score.printed:.3f}"
    name = PRINTED_TARGETS[score.name][score.column]
    note = f"which rows the thesis trained on is not stated; {len(scores)} draws give {low:.4f} to {high:.4f}"
    if name == "n":
        note += "; the row is labelled m, which stands there twice"
    nearest = min(scores, key=lambda v: abs(v - score.printed))
    if any(agrees(printed, v) for v in scores):
        mark = Mark.REMADE
    else:
        mark = Mark.NOT_STATED if low <= score.printed <= high else Mark.NOT_REPRODUCIBLE
    return Figure("5.1", score.name, f"R2 of {name}", printed, mark, nearest, note=note)
