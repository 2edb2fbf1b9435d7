"""The thesis's comparison tables with every method on the same records, and the printed figures."""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING

from autotuner.core.identification.learned.correction import LEARNED, by_learned
from autotuner.errors import InputError
from autotuner_models.literature import METHODS, Method
from autotuner_models.literature.trial import BIASED, FOPDT, SOPDT
from autotuner_models.report import Cell, Column, ReportTable, percent_off
from autotuner_models.shipped import provider
from autotuner_models.thesis.data_sets import DECIBELS
from autotuner_models.thesis.printed import OFFLINE, TABLES
from autotuner_models.trials import trial_of

if TYPE_CHECKING:
    from autotuner.core.identification.result import Estimate
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature import Trial
    from autotuner_models.thesis.printed import Row, ThesisTable

OWN = {OFFLINE: "describing_function"}
"""Comparator of the thesis's own row."""
NAMED_ONLY: dict[tuple[str, str], str] = {
    ("2.1", "Gerov"): "not stated: Lambert's W is named, no equation; the closed form solves the same cycle without it",
    ("2.3", "Chen et al."): "not stated: T 3.96 D 3.35 are printed without a method",
    ("5.6", "Lavanya et al."): "not stated: m 0.9869 n 0.4252 are those of eqs. 3.22, 3.23 on the stated A and Pu",
}
"""Methods that the thesis names, by table, without a principle that could be implemented."""
EXACT = "least_squares"
EXACT_WITHIN = 1e-3
"""Relative error that least squares must stay under without noise."""


def _learned(trial: Trial) -> ProcessModel:
    """Return the trained correction of the asymmetric relay test, with the true static gain."""
    estimate = by_learned(trial.recording(BIASED), trial.structure, (trial.K, 0.0), provider())
    if estimate.model is None:
        raise InputError(estimate.refusal or "gives no model", field=f"tests.{BIASED}", remedy="Use least squares.")
    return estimate.model


COMPARED = (
    *METHODS[:-1],
    Method(LEARNED, "Learned correction (this program)", FOPDT + SOPDT, _learned, finds=("D",)),
    METHODS[-1],
)
"""The literature's methods, then this program's own two."""


def methods_table(decibels: float | None = None) -> ReportTable:
    """Return every table's process as each method sees it, without noise or with."""
    rows = [_row(table, method, decibels) for table in TABLES for method in COMPARED]
    shown = [row for row in rows if row is not None]
    shown += [(number, method, "", "", why) for (number, method), why in NAMED_ONLY.items()]
    noise = "without noise" if decibels is None else f"with noise {decibels:g} dB below the oscillation"
    return ReportTable(
        "methods" if decibels is None else "methods_with_noise",
        f"Tables 2.1-2.3 and 5.2-5.7 by every method, {noise}",
        (
            Column("table", "table"),
            Column("method", "method"),
            Column("model", "model"),
            Column("errors_percent", "errors %"),
            Column("printed", "printed in the thesis"),
        ),
        tuple(shown),
        note="`given`: what a method cannot find is given to it, and its error is not shown.",
        failures=tuple(_failures()) if decibels is None else (),
    )


noisy_methods_table = partial(methods_table, DECIBELS)


def remade_by_methods() -> dict[tuple[str, str], dict[str, float]]:
    """Return the results of each comparator without noise, by number of the table and name of the comparator."""
    return {
        (table.number, method.name): model.parameters()
        for table in TABLES
        for method in METHODS
        if table.structure in method.structures and (model := _estimate(table.number, method, None).model) is not None
    }


@cache
def _estimate(number: str, method: Method, decibels: float | None) -> Estimate:
    return method.apply(_trial(number, decibels))


@cache
def _trial(number: str, decibels: float | None) -> Trial:
    table = next(table for table in TABLES if table.number == number)
    return trial_of(table.structure, table.truth, decibels)


def _row(table: ThesisTable, method: Method, decibels: float | None) -> tuple[Cell, ...] | None:
    if table.structure not in method.structures:
        return None
    estimate = _estimate(table.number, method, decibels)
    printed = "; ".join(
        f"{row.method}: {_values(row)}" for row in table.rows if method.name == (row.remade_by or OWN.get(row.method))
    )
    if estimate.model is None:
        return table.number, method.title, estimate.refusal, "", printed
    found = estimate.model.parameters()
    given = method.given(table.structure)
    compared = {name: truth for name, truth in table.truth.items() if name in found and name not in given}
    errors = {name: percent_off(found[name], truth) for name, truth in compared.items()}
    same = estimate.model.structure == table.structure
    model = " ".join(f"{name} {value:.5g}{' (given)' * (name in given)}" for name, value in found.items())
    shown = " ".join(f"{name} {error:+.2g}" for name, error in errors.items()) if same else estimate.model.structure
    return table.number, method.title, model, shown, printed


def _values(row: Row) -> str:
    return " ".join(f"{name} {value}" for name, value in row.printed.items())


def _failures() -> list[str]:
    """Return where least squares misses the process without noise."""
    found = remade_by_methods()
    return [
        f"table {table.number}: least squares gives {name} {value}, not {truth:g}"
        for table in TABLES
        for name, truth in table.truth.items()
        if abs((value := found.get((table.number, EXACT), {}).get(name, 0.0)) / truth - 1.0) > EXACT_WITHIN
    ]
