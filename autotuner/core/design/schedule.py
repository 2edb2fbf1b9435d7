"""Gains that change with the operating point: one table from tunings at several points.

A schedule is rows in order of a scheduling variable (the set point, the PV, the output). Between two rows the border
lies in the middle; it is crossed only when the variable has passed it by the hysteresis, so that noise at a border does
not switch the gains to and fro. A pair for heating and cooling is a schedule over the output with its border at zero.

Invariants: a schedule is a frozen value; selecting is a pure function of the value and the row in force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner.core.design.gains import PidGains

HYSTERESIS_SHARE = 0.1
"""Default hysteresis as a share of the distance of two rows."""


@dataclass(frozen=True, slots=True)
class ScheduleRow:
    """One operating point: value of the scheduling variable during the tuning, and the gains."""

    value: float
    gains: PidGains


@dataclass(frozen=True, slots=True)
class GainSchedule:
    """Gains over a scheduling variable.

    Attributes
    ----------
    rows : tuple of ScheduleRow
        Operating points, in increasing order of the variable.
    borders : tuple of float
        Where one row gives way to the next, one fewer than rows.
    hysteresis : float
        How far a border must be passed, units of the variable.
    """

    rows: tuple[ScheduleRow, ...]
    borders: tuple[float, ...]
    hysteresis: float

    def select(self, value: float, current: int | None = None) -> int:
        """Return the row for a value of the variable; `current` is the row in force, None at the start."""
        row = sum(value > border for border in self.borders) if current is None else current
        while row < len(self.borders) and value > self.borders[row] + self.hysteresis:
            row += 1
        while row > 0 and value < self.borders[row - 1] - self.hysteresis:
            row -= 1
        return row

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "rows": [{"value": row.value, "gains": row.gains.to_dict()} for row in self.rows],
            "borders": list(self.borders),
            "hysteresis": self.hysteresis,
        }


def gain_schedule(rows: Iterable[tuple[float, PidGains]], hysteresis: float | None = None) -> GainSchedule:
    """Return the schedule of gains tuned at several operating points, given in any order.

    Raises
    ------
    InputError
        Fewer than two points, a value that is not finite or given twice, gains of different action, or a hysteresis
        that is negative or wider than half the distance of two points.
    """
    ordered = tuple(ScheduleRow(float(value), gains) for value, gains in sorted(rows, key=lambda row: row[0]))
    _check_rows(ordered)
    distances = [b.value - a.value for a, b in pairwise(ordered)]
    width = HYSTERESIS_SHARE * min(distances) if hysteresis is None else hysteresis
    if not 0.0 <= width <= min(distances) / 2.0:
        raise InputError(
            "must lie between 0 and half the distance of two operating points",
            field="schedule.hysteresis",
            value=width,
            remedy=f"Give at most {min(distances) / 2.0:g}.",
        )
    return GainSchedule(ordered, tuple((a.value + b.value) / 2.0 for a, b in pairwise(ordered)), width)


def heat_cool(heating: PidGains, cooling: PidGains, hysteresis: float) -> GainSchedule:
    """Return the schedule over the output of a loop that heats above zero and cools below it.

    Raises
    ------
    InputError
        The gains are of different action, or the hysteresis is not positive and finite.
    """
    if not 0.0 < hysteresis < math.inf:
        raise InputError(
            "must be positive", field="schedule.hysteresis", value=hysteresis, remedy="Give output units around zero."
        )
    return gain_schedule([(-2.0 * hysteresis, cooling), (2.0 * hysteresis, heating)], hysteresis)


def _check_rows(rows: tuple[ScheduleRow, ...]) -> None:
    values = [row.value for row in rows]
    problems = {
        "needs two operating points at least": len(rows) < 2,
        "has an operating point that is not a finite number": not all(map(math.isfinite, values)),
        "has the same operating point twice": len(set(values)) < len(values),
        "mixes direct and reverse action, which cannot belong to one loop": len({row.gains.action for row in rows}) > 1,
    }
    for what, holds in problems.items():
        if holds:
            raise InputError(what, field="schedule.rows", value=values, remedy="Check the tunings that it is made of.")
