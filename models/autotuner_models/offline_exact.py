"""The thesis's "Offline" rows on exact limit cycles of the true process, and the describing function's bias over D/T.

Both use the peak of the wave for FOPDT and its fundamental for SOPDT, as the thesis does, and give the static gain (and
for SOPDT the dead time). The errors of the closed forms are rounding only.
"""

from __future__ import annotations

import math

from scipy.optimize import brentq

from autotuner.core.identification.limit_cycle.describing_function import ultimate_point
from autotuner_models.estimates import H, by_describing_function, by_fundamental, by_peak
from autotuner_models.report import Cell, Column, ReportTable, percent_off
from autotuner_models.thesis.marks import half_digit
from autotuner_models.thesis.printed import BIAS, BIAS_RATIOS, OFFLINE, TABLES, ThesisTable
from autotuner_sim import PLANTS, Fopdt, LimitCycle, find_limit_cycle, symmetric_relay

CLOSED_FORM_WITHIN = 1e-6
"""Relative error above which a closed form has failed."""
BIAS_WITHIN = 0.1
"""Percentage points by which a bias may differ from the known figure, or half of that figure's last digit."""

Line = tuple[Cell, ...]


def exact_table() -> ReportTable:
    """Return the printed figures and those of exact limit cycles, with amplitude and period."""
    lines = [line for table in TABLES for line in _lines(table)]
    return ReportTable(
        "exact",
        "Offline rows from exact limit cycles of the true process",
        (
            Column("table", "table"),
            Column("figure", "figure"),
            Column("truth", "truth", ".6g"),
            Column("printed", "printed"),
            Column("ours", "ours", ".6g"),
            Column("error_percent", "error %", "+.2f"),
            Column("by_peak", "DF, peak", ".6g"),
            Column("by_fundamental", "DF, fundamental", ".6g"),
            Column("closed_form", "closed form", ".10g"),
            Column("closed_form_error", "relative error", ".0e"),
        ),
        tuple(lines),
        note="`ours` reads A as the thesis does: the peak for FOPDT, the fundamental for SOPDT.",
        failures=tuple(
            f"table {line[0]}: the closed form misses {line[1]} by {line[9]:.2g}"
            for line in lines
            if isinstance(line[9], float) and abs(line[9]) > CLOSED_FORM_WITHIN
        ),
    )


def _lines(table: ThesisTable) -> list[Line]:
    cycle = find_limit_cycle(PLANTS[table.structure](**table.truth), symmetric_relay(H))
    is_first_order = table.structure == "fopdt"
    peak, fundamental = (
        by_describing_function(table.structure, table.truth, A, cycle.period_s).parameters()
        for A in (cycle.peak, cycle.fundamental)
    )
    closed = by_peak(table.truth["K"], cycle.peak, cycle.period_s) if is_first_order else None
    ours = peak if is_first_order else fundamental
    lines = _cycle_lines(table, cycle, cycle.peak if is_first_order else cycle.fundamental)
    for name, printed in table.row(OFFLINE).printed.items():
        truth = table.truth[name]
        exact = closed.parameters()[name] if closed else None
        lines.append(
            (
                *(table.number, name, truth, printed, ours[name], percent_off(ours[name], truth)),
                *(peak[name], fundamental[name], exact, exact / truth - 1.0 if exact is not None else None),
            )
        )
    return lines


def _cycle_lines(table: ThesisTable, cycle: LimitCycle, amplitude: float) -> list[Line]:
    """Return amplitude and period: the thesis's and the exact ones."""
    nothing = (None,) * 2
    return [
        (table.number, "A", None, table.A, amplitude, None, cycle.peak, cycle.fundamental, *nothing),
        (table.number, "Pu", None, table.Pu, cycle.period_s, None, None, None, *nothing),
    ]


def bias_table() -> ReportTable:
    """Return the describing function's errors on exact FOPDT cycles, its known bias, and the closed forms' errors."""
    lines: list[Line] = []
    failures: list[str] = []
    for i, ratio in enumerate(BIAS_RATIOS):
        plant = Fopdt(1.0, 1.0, ratio)
        cycle = find_limit_cycle(plant, symmetric_relay(H))
        errors, left = bias_percent(plant, cycle), closed_form_errors(plant, cycle)
        lines.append((ratio, *(cell for name in BIAS for cell in (errors[name], BIAS[name][i])), *left.values()))
        failures += [
            f"D/T {ratio:g}: the error of {name} is {errors[name]:.2f} %, known {known[i]} %"
            for name, known in BIAS.items()
            if abs(errors[name] - float(known[i])) > _tolerance(known[i])
        ]
        failures += [
            f"D/T {ratio:g}: the closed form on the {reading} misses by {error:.2g}"
            for reading, error in left.items()
            if error is not None and error > CLOSED_FORM_WITHIN
        ]
    columns = [
        column
        for name in BIAS
        for column in (
            Column(f"{name}_error_percent", f"{name} error %", "+.2f"),
            Column(f"{name}_known_percent", "known"),
        )
    ]
    return ReportTable(
        "bias",
        "Bias of the describing function on exact FOPDT cycles (peak, K known); relative error left by closed forms",
        (
            Column("ratio", "D/T", "g"),
            *columns,
            Column("closed_form_peak_error", "closed form, peak", ".0e"),
            Column("closed_form_fundamental_error", "closed form, fundamental", ".0e"),
        ),
        tuple(lines),
        note="The peak shows D/T only as long as `1 - e^(-D/T)` is not 1 to the last digit.",
        failures=tuple(failures),
    )


def bias_percent(plant: Fopdt, cycle: LimitCycle) -> dict[str, float]:
    """Return the describing function's errors on a cycle, in percent."""
    N, w = ultimate_point(H, cycle.peak, cycle.period_s)
    true_w = brentq(lambda w: w * plant.D + math.atan(w * plant.T) - math.pi, 0.0, math.pi / plant.D, xtol=1e-14)
    model = by_describing_function("fopdt", {"K": plant.K}, cycle.peak, cycle.period_s).parameters()
    return {
        "Ku": percent_off(abs(N) * plant.K, math.hypot(1.0, true_w * plant.T)),
        "Pu": percent_off(true_w, w),
        "T": percent_off(model["T"], plant.T),
        "D": percent_off(model["D"], plant.D),
    }


def closed_form_errors(plant: Fopdt, cycle: LimitCycle) -> dict[str, float | None]:
    """Return the larger relative error of T and D by each reading of the amplitude; None where it cannot see them."""
    models = {
        "peak": by_peak(plant.K, cycle.peak, cycle.period_s),
        "fundamental": by_fundamental(plant.K, cycle.fundamental, cycle.period_s),
    }
    return {
        reading: max(abs(model.T / plant.T - 1.0), abs(model.D / plant.D - 1.0)) if model else None
        for reading, model in models.items()
    }


def _tolerance(known: str) -> float:
    return max(BIAS_WITHIN, 5.0 if known.endswith("0") and "." not in known else half_digit(known))
