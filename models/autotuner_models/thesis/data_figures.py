"""Tables 4.1 to 4.4, figure by figure: the rows of training data that the thesis prints.

    A, Pu           tables 4.1, 4.2: the exact cycle of the process that the row's number gives
                    tables 4.3, 4.4: the exact cycle of the nearest process of the thesis's grid; none is stated
    T, D, T1, ...   eqs. 3.5, 3.6, 3.13, 3.14, 3.22, 3.23 on the printed A and Pu
    Pu of 4.4       copied from table 4.3; correct is the Pu that gives the row's m and n

The gains and dead times of the rows are inputs of the simulation, so they are not reproduced.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from autotuner.errors import InputError
from autotuner_models.estimates import H, by_describing_function
from autotuner_models.thesis.data_sets import N_GRID, T_GRID
from autotuner_models.thesis.marks import Figure, Mark, agrees, half_digit
from autotuner_models.thesis.printed import TABLE_4_1, TABLE_4_2, TABLE_4_3, TABLE_4_4
from autotuner_models.thesis.stated_cycle import implied_cycle, second_order_of
from autotuner_sim import Fopdt, find_limit_cycle, symmetric_relay
from autotuner_sim.relay.batch import relay_tests, run_relay_tests

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from autotuner_models.thesis.printed import DataTable

COARSE = "the exact cycle differs: the thesis read the largest sample of a simulation of limited step"
SEED = "depends on the noise drawn, of which the thesis states the variance alone"
COPIED = (
    "the same as in table 4.1 to the last digit in all rows, although noise that reaches the relay moves its switches"
)
UNKNOWN = "the process is not stated; the nearest of the thesis's grid is"
TRIED = 40
"""Processes of the grid that are tried for a row of tables 4.3 and 4.4."""
SAME_ROWS = 580
"""Number of the first of the last five rows of tables 4.1 and 4.2."""


def data_figures() -> list[Figure]:
    """Return the printed figures of tables 4.1 to 4.4 with their marks."""
    figures: list[Figure] = []
    for table in (TABLE_4_1, TABLE_4_2):
        for number in table.rows:
            figures += _first_order(table, number)
    for table in (TABLE_4_3, TABLE_4_4):
        for number in table.rows:
            figures += _second_order(table, number)
    return figures


def _values(table: DataTable, number: int) -> dict[str, float]:
    """Return a row as it should read."""
    row = dict(zip(table.columns, table.rows[number], strict=True))
    wrong = {name: table.misprints[number, name].right for name in row if (number, name) in table.misprints}
    return {name: float(value) for name, value in (row | wrong).items()}


def _first_order(table: DataTable, number: int) -> Iterator[Figure]:
    row = dict(zip(table.columns, table.rows[number], strict=True))
    values = _values(table, number)
    early = number < SAME_ROWS
    plant = Fopdt(
        values["K"], (1.0 + 0.5 * number) if early else 18.0 + 0.5 * (number - SAME_ROWS), 2.0 if early else 8.0
    )
    cycle = find_limit_cycle(plant, symmetric_relay(H))
    noisy = table is TABLE_4_2
    for name, exact in (("A", cycle.peak), ("Pu", cycle.period_s)):
        if noisy:
            mark = Mark.NOT_STATED if name == "A" else Mark.NOT_REPRODUCIBLE
            yield Figure(table.number, str(number), name, row[name], mark, exact, note=SEED if name == "A" else COPIED)
        else:
            same = agrees(row[name], exact)
            mark = Mark.REMADE if same else Mark.NOT_REPRODUCIBLE
            yield Figure(table.number, str(number), name, row[name], mark, exact, note="" if same else COARSE)
    yield from _estimates(table, number, row, {"K": values["K"]}, (row["A"], row["Pu"]))


def _second_order(table: DataTable, number: int) -> Iterator[Figure]:
    row = dict(zip(table.columns, table.rows[number], strict=True))
    values = _values(table, number)
    K, D = values["K"], values["D"]
    A, Pu = implied_cycle(K, D, *second_order_of(values))
    copied = table is TABLE_4_4
    described, near_A, near_Pu = _nearest(table, values, Pu if copied else values["Pu"])
    note = f"{UNKNOWN} {described} with A {near_A:.4g} and Pu {near_Pu:.5g} s"
    same = agrees(row["A"], near_A)
    yield Figure(table.number, str(number), "A", row["A"], Mark.REMADE if same else Mark.NOT_STATED, near_A, note=note)
    if copied:
        right = f"{Pu:.3f}"
        why = f"copied from table 4.3; the row's m and n follow from {right}, and A {A:.4g} with them"
        yield Figure(table.number, str(number), "Pu", row["Pu"], Mark.MISPRINT, Pu, right, why)
    else:
        right, same = row["Pu"], agrees(row["Pu"], near_Pu)
        mark = Mark.REMADE if same else Mark.NOT_STATED
        yield Figure(table.number, str(number), "Pu", row["Pu"], mark, near_Pu, note=note)
    yield from _estimates(table, number, row, {"K": K, "D": D}, (row["A"], right))


def _estimates(
    table: DataTable, number: int, row: Mapping[str, str], known: Mapping[str, float], cycle: tuple[str, str]
) -> Iterator[Figure]:
    """Return the describing function's columns: arithmetic on the printed amplitude and period."""
    A, Pu = cycle
    a, p = half_digit(A), half_digit(Pu)
    corners = [
        _estimate(table, known, float(A) + i * a, float(Pu) + j * p) for i, j in itertools.product((-1, 1), repeat=2)
    ]
    ours = _estimate(table, known, float(A), float(Pu))
    for name in table.columns[-2:]:
        wrong = table.misprints.get((number, name))
        span = [corner[name] for corner in corners if name in corner]
        value = ours.get(name)
        fits = value is not None and agrees(wrong.right if wrong else row[name], value, min(span), max(span))
        if wrong is not None:
            mark = Mark.MISPRINT if fits else Mark.DIFFERS
            yield Figure(table.number, str(number), name, row[name], mark, value, wrong.right, wrong.why)
        elif fits:
            yield Figure(table.number, str(number), name, row[name], Mark.ARITHMETIC, value)
        else:
            values = _values(table, number)
            A_row, Pu_row = implied_cycle(values["K"], known.get("D", values["D"]), *second_order_of(values))
            note = f"does not follow from A and Pu of its row; the row follows from A {A_row:.4g} and Pu {Pu_row:.4g} s"
            yield Figure(table.number, str(number), name, row[name], Mark.NOT_REPRODUCIBLE, value, note=note)


def _estimate(table: DataTable, known: Mapping[str, float], A: float, Pu: float) -> dict[str, float]:
    try:
        return by_describing_function(table.structure, known, A, Pu).parameters()
    except InputError:
        return {}


def _nearest(table: DataTable, values: Mapping[str, float], Pu: float) -> tuple[str, float, float]:
    """Return the process of the thesis's grid whose exact cycle is nearest, and its amplitude and period.

    Only those near the row's own estimate are tried: the describing function is wrong by some tenths, not by more.
    """
    K, D, A = values["K"], values["D"], values["A"]
    m_row, n_row = second_order_of(values)
    if table is TABLE_4_3:
        T1, T2 = np.array([pair for pair in itertools.product(T_GRID, repeat=2) if pair[0] >= pair[1]]).T
        m, n = T1 * T2, T1 + T2
    else:
        m, n = np.array(
            [(m, n) for m, n in itertools.product(T_GRID, N_GRID) if n * n < 4.0 * m and n * n > 0.04 * m]
        ).T
        T1, T2 = m, n
    near = np.argsort(np.abs(np.log(m / m_row)) + np.abs(np.log(n / n_row)))[:TRIED]
    m, n, T1, T2 = m[near], n[near], T1[near], T2[near]
    one = np.ones(m.size)
    cycles = run_relay_tests(relay_tests(K * one, m, n, D * one, -H, H), switches=200)
    away = np.abs(np.log(cycles.fundamental / A)) + np.abs(np.log(cycles.period_s / Pu))
    best = int(np.nanargmin(away))
    names = ("T1", "T2") if table is TABLE_4_3 else ("m", "n")
    described = f"{names[0]} {T1[best]:g}, {names[1]} {T2[best]:.3g}"
    return described, float(cycles.fundamental[best]), float(cycles.period_s[best])
