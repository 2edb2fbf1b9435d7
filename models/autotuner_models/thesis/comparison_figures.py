"""Tables 2.1 to 2.3 and 5.2 to 5.7, figure by figure, each with its mark.

parameters, Offline     from the stated A and Pu, or from those that they imply
parameters, Proposed    from the thesis's own regressors, trained on several draws of its data set
parameters, literature  from a comparator of the same principle on a record without noise
errors                  arithmetic on the printed parameters
"% Error"               undefined in the thesis; candidates, each a measure of a whole model:

    parameters    mean of |p/p_true - 1| over the parameters that both models have
    frequency     mean and largest |Gm/G - 1| up to the frequency at which G lags by half a turn
    step          int |ym - y| dt / int |y| dt of the step response over a window

The text calls one of them an "absolute integral error". With a window of 16.6 s the last gives 1.28 and 1.24 in table
2.3, and 30.1 for the printed 29.48: near, and the window is fitted, so it is no definition.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.signal import step

from autotuner_models.thesis.marks import Figure, Mark, agrees
from autotuner_models.thesis.printed import OFFLINE, PROPOSED, TABLES
from autotuner_models.thesis.stated_cycle import exact_figures, from_stated_cycle, implied_cycle, second_order_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from autotuner_models.thesis.printed import Row, ThesisTable

    Numbers = NDArray[np.float64]

NOT_STATED: dict[str, str] = {
    "Lavanya et al.": "the thesis does not state the method; eqs. 3.22, 3.23 on the stated A and Pu give this figure",
    "Chen et al. (first order)": "the thesis does not state the method, only that the model is of first order",
}
"""Rows of methods that the thesis names without a principle that could be implemented."""
SETTINGS: dict[str, str] = {
    "two_relays": "the extra dead time of the second relay test is not stated; from 0.05 to 5 s T stays at 8.11 and D "
    "at 1.99 to 2.00 in table 2.1",
    "describing_function": "amplitude and period are not stated",
    "online": "the controller beside the relay is not stated; gains after Ziegler and Nichols were tried",
    "state_space": "hysteresis and noise are not stated; the same equations without noise give the process itself",
    "dual_input": "bias and amplitude of the relay are not stated",
    "sampled_data": "the sample interval is not stated; without noise the same fit gives the process itself",
    "step_integral": "size and length of the step are not stated",
}
"""Inputs of a literature method that the thesis does not state, and the values tried, by comparator."""
WINDOW_S = 16.6
"""Window of the step response at which the first and third row of table 2.3 come out."""
POINTS = 4000
"""Points of an integral over frequency or time."""


def error_figures() -> list[Figure]:
    """Return every printed error of a parameter, from the printed parameters."""
    return [figure for table in TABLES for row in table.rows for figure in _errors(table, row)]


def percent_figures() -> list[Figure]:
    """Return the figures of the columns "% Error" of tables 2.3 and 5.4."""
    return [figure for table in TABLES for row in table.rows for figure in _percent(table, row)]


def offline_figures() -> list[Figure]:
    """Return the parameters of the "Offline" rows."""
    return [figure for table in TABLES for figure in _offline(table)]


def literature_figures(remade: Mapping[tuple[str, str], Mapping[str, float]]) -> list[Figure]:
    """Return the parameters of the literature's rows; `remade`: the comparators' results, by table and comparator."""
    return [
        figure
        for table in TABLES
        for row in table.rows
        if row.method not in {OFFLINE, PROPOSED}
        for figure in _literature(table, row, remade.get((table.number, row.remade_by), {}))
    ]


def proposed_figures(predicted: Mapping[tuple[str, str], tuple[float, ...]]) -> list[Figure]:
    """Return the parameters of the "Proposed" rows; `predicted` holds the results of each draw, by table and name."""
    return [figure for table in TABLES for row in table.rows if row.method == PROPOSED for figure in _proposed(
        table, row, predicted)]  # fmt: skip


def _errors(table: ThesisTable, row: Row) -> Iterator[Figure]:
    for name, printed in row.errors.items():
        title, wrong = f"error in {name}", row.misprint(f"error in {name}")
        parameter = row.misprint(name)
        figure = float(parameter.right if parameter else row.printed[name])
        error = 100.0 * abs(figure / table.truth[name] - 1.0)
        if wrong:
            right = agrees(wrong.right, error)
            mark = Mark.MISPRINT if right else Mark.DIFFERS
            yield Figure(table.number, row.method, title, printed, mark, error, wrong.right, wrong.why)
        else:
            mark = Mark.ARITHMETIC if agrees(printed, error) else Mark.DIFFERS
            yield Figure(table.number, row.method, title, printed, mark, error)


def _percent(table: ThesisTable, row: Row) -> Iterator[Figure]:
    if row.percent is None:
        return
    if float(row.percent) == 0.0:
        yield Figure(table.number, row.method, "% error", row.percent, Mark.ARITHMETIC, 0.0, note="the process itself")
        return
    tried = _percent_errors(table, row)
    words = "; ".join(f"{name} {value:.4g} %" for name, value in tried.items())
    note = f"the thesis does not define it. Tried: {words}"
    yield Figure(table.number, row.method, "% error", row.percent, Mark.NOT_REPRODUCIBLE, note=note)


def _offline(table: ThesisTable) -> Iterator[Figure]:
    row = table.row(OFFLINE)
    for name, printed in row.printed.items():
        if table.A is None:
            yield _implied(table, row, name, printed)
            continue
        ours, least, greatest = from_stated_cycle(table, name)
        wrong = row.misprint(name)
        right = wrong.right if wrong else printed
        fits = agrees(right, ours, least, greatest)
        mark = (Mark.MISPRINT if wrong else Mark.REMADE) if fits else Mark.DIFFERS
        notes = [wrong.why] if wrong else []
        notes += [f"with A {table.misprint.right}: {table.misprint.why}"] if table.misprint else []
        yield Figure(
            table.number, OFFLINE, name, printed, mark, ours, wrong.right if wrong else None, "; ".join(notes)
        )  # fmt: skip


def _implied(table: ThesisTable, row: Row, name: str, printed: str) -> Figure:
    exact, A, Pu = exact_figures(table)
    given = {**table.truth, **{key: float(value) for key, value in row.printed.items()}}
    from_A, from_Pu = implied_cycle(given["K"], given["D"], *second_order_of(given))
    note = (
        f"A and Pu are not stated; the row follows from A {from_A:.4g} and Pu {from_Pu:.4g} s, the exact cycle has "
        f"{A:.4g} and {Pu:.4g} s"
    )
    same = agrees(printed, exact[name])
    return Figure(
        table.number, OFFLINE, name, printed, Mark.REMADE if same else Mark.NOT_STATED, exact[name], note=note
    )  # fmt: skip


def _literature(table: ThesisTable, row: Row, found: Mapping[str, float]) -> Iterator[Figure]:
    for name, printed in row.printed.items():
        ours = found.get(name)
        if row.method in NOT_STATED:
            ours = _by_equations(table, name) if row.method.startswith("Lavanya") else None
            yield Figure(table.number, row.method, name, printed, Mark.NOT_STATED, ours, note=NOT_STATED[row.method])
        elif ours is not None and agrees(printed, ours):
            yield Figure(table.number, row.method, name, printed, Mark.REMADE, ours)
        else:
            note = SETTINGS[row.remade_by]
            yield Figure(table.number, row.method, name, printed, Mark.NOT_REPRODUCIBLE, ours, note=note)


def _by_equations(table: ThesisTable, name: str) -> float:
    return from_stated_cycle(table, name)[0]


def _proposed(table: ThesisTable, row: Row, predicted: Mapping[tuple[str, str], tuple[float, ...]]) -> Iterator[Figure]:
    for name, printed in row.printed.items():
        if (wrong := row.misprint(name)) is not None:
            yield Figure(table.number, PROPOSED, name, printed, Mark.MISPRINT, None, wrong.right, wrong.why)
            continue
        draws = predicted[table.number, name]
        low, high = min(draws), max(draws)
        note = f"which rows the thesis trained on is not stated; {len(draws)} draws give {low:.5g} to {high:.5g}"
        nearest = min(draws, key=lambda v: abs(v - float(printed)))
        mark = Mark.REMADE if any(agrees(printed, v) for v in draws) else (
            Mark.NOT_STATED if low <= float(printed) <= high else Mark.NOT_REPRODUCIBLE
        )  # fmt: skip
        yield Figure(table.number, PROPOSED, name, printed, mark, nearest, note=note)


def _percent_errors(table: ThesisTable, row: Row) -> dict[str, float]:
    """Return each measure in percent."""
    found = {name: float(wrong.right if (wrong := row.misprint(name)) else v) for name, v in row.printed.items()}
    common = [name for name in found if name in table.truth and name not in {"K", "D"}]
    mean = float(np.mean([abs(found[n] / table.truth[n] - 1.0) for n in common])) if common else math.nan
    found = {"K": table.truth["K"], "D": table.truth["D"], **found}
    model, truth = _response(found), _response(table.truth)
    w = np.linspace(1e-4, _turnover(truth, table.truth["D"]), POINTS)
    relative = np.abs(model(w) / truth(w) - 1.0)
    measures = {
        "mean of the parameters": mean,
        "mean over the frequencies": float(relative.mean()),
        "largest over the frequencies": float(relative.max()),
        "integral of the step response": _step_error(found, table.truth),
    }
    return {name: 100.0 * value for name, value in measures.items() if math.isfinite(value)}


def _response(p: Mapping[str, float]) -> Callable[[Numbers], NDArray[np.complex128]]:
    m, n = second_order_of(p)
    return lambda w: p["K"] * np.exp(-1j * w * p["D"]) / (1.0 - m * w * w + 1j * n * w)


def _turnover(response: Callable[[Numbers], NDArray[np.complex128]], D: float) -> float:
    def phase_lag(w: float) -> float:
        return float(np.unwrap(np.angle(response(np.linspace(1e-4, w, 400))))[-1]) + math.pi

    return float(brentq(phase_lag, 1e-2, math.pi / D))


def _step_error(model: Mapping[str, float], truth: Mapping[str, float]) -> float:
    t = np.linspace(0.0, WINDOW_S, POINTS)
    ym, y = (_step(p, t) for p in (model, truth))
    return float(np.abs(ym - y).sum() / np.abs(y).sum())


def _step(p: Mapping[str, float], t: Numbers) -> Numbers:
    m, n = second_order_of(p)
    when, y = step(([p["K"]], [m, n, 1.0] if m > 0.0 else [n, 1.0]), T=t)
    return np.interp(t - p["D"], when, y, left=0.0)
