"""The thesis's comparison tables with every method on the same records, beside the figures printed."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from autotuner.core.identification.learned import LEARNED, by_learned
from autotuner.core.identification.methods import METHODS, Method
from autotuner.core.identification.methods.trial import BIASED, FOPDT, SOPDT
from autotuner.errors import InputError
from autotuner_models.report import Cell, Column, ReportTable, percent_off
from autotuner_models.shipped import provider
from autotuner_models.thesis_tables import TABLES
from autotuner_models.trials import trial_of

if TYPE_CHECKING:
    from autotuner.core.identification.methods import Trial
    from autotuner.core.process import ProcessModel
    from autotuner_models.thesis_tables import ThesisTable

PRINTED: dict[str, tuple[str, ...]] = {
    "describing_function": ("Offline", "Kumar et al. (offline)", "Lavanya et al."),
    "online": ("Kumar et al. (online)",),
    "two_relays": ("Li et al.",),
    "dual_input": ("Shen et al.",),
    "state_space": ("Bajrangbali et al.",),
    "sampled_data": ("Chang et al.",),
    "step_integral": ("Fedele (step)", "Chen et al. (first order)"),
}
"""Rows of the thesis that a method is held beside."""
DECIBELS = 20.0
EXACT = "least_squares"
EXACT_WITHIN = 1e-3
"""Relative error that least squares must stay under without noise."""


def _learned(trial: Trial) -> ProcessModel:
    """Return what the trained correction makes of the asymmetric relay test, given the static gain it cannot show."""
    estimate = by_learned(trial.recording(BIASED), trial.structure, None, provider(), fallback=(trial.K, 0.0))
    if estimate.model is None:
        raise InputError(estimate.refusal or "gives no model", field=f"tests.{BIASED}", remedy="Use least squares.")
    return estimate.model


COMPARED = (*METHODS[:-1], Method(LEARNED, "Learned correction (this program)", FOPDT + SOPDT, _learned), METHODS[-1])
"""The literature's methods, then this program's own two."""


def methods_table(decibels: float | None = None) -> ReportTable:
    """Return every table's process as each method sees it, without noise or with."""
    trials = [(table, trial_of(table.structure, table.truth, decibels)) for table in TABLES]
    rows = [_row(table, method, trial) for table, trial in trials for method in COMPARED]
    shown = [row for row in rows if row is not None]
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
        note="Given to those that cannot find them: the static gain, and the dead time of second-order processes.",
        failures=tuple(_failures(trials)) if decibels is None else (),
    )


noisy_methods_table = partial(methods_table, DECIBELS)


def _row(table: ThesisTable, method: Method, trial: Trial) -> tuple[Cell, ...] | None:
    if table.structure not in method.structures:
        return None
    estimate = method.apply(trial)
    printed = "; ".join(
        f"{row.method}: " + _values(row.printed)
        for row in table.rows
        if any(row.method.startswith(name) for name in PRINTED.get(method.name, ()))
    )
    if estimate.model is None:
        return table.number, method.title, estimate.refusal, "", printed
    found = estimate.model.parameters()
    errors = {name: percent_off(found[name], truth) for name, truth in table.truth.items() if name in found}
    same = estimate.model.structure == table.structure
    model = " ".join(f"{name} {value:.5g}" for name, value in found.items())
    shown = " ".join(f"{name} {error:+.2g}" for name, error in errors.items()) if same else estimate.model.structure
    return table.number, method.title, model, shown, printed


def _values(printed: object) -> str:
    return " ".join(f"{name} {value}" for name, value in printed.items()) if isinstance(printed, dict) else ""


def _failures(trials: list[tuple[ThesisTable, Trial]]) -> list[str]:
    """Return where least squares misses the process without noise."""
    method = next(method for method in METHODS if method.name == EXACT)
    missed = []
    for table, trial in trials:
        model = method.apply(trial).model
        found = {} if model is None else model.parameters()
        missed += [
            f"table {table.number}: least squares gives {name} {found.get(name)}, not {truth:g}"
            for name, truth in table.truth.items()
            if abs(found.get(name, 0.0) / truth - 1.0) > EXACT_WITHIN
        ]
    return missed
