"""The thesis's "online" row of table 2.1: a relay in parallel with a controller, `(N + Gc(jw)) G(jw) = -1`.

The thesis prints the result of the describing function but not the controller. Ours are Ziegler and Nichols' P, PI
and PID rules on the offline relay test of the same process, the usual result of a first autotune. The cycle
is that of a continuous controller under an ideal relay (`autotuner_sim.relay.parallel_pid`); the peak is taken for the
amplitude, as in the thesis's first-order rows, and the static gain is given.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.design import UltimatePoint, apply_rule
from autotuner.core.identification.limit_cycle import online_relay
from autotuner.core.identification.limit_cycle.describing_function import fopdt, ultimate_point
from autotuner_models.estimates import H
from autotuner_models.report import Column, ReportTable, percent_off
from autotuner_models.thesis.printed import TABLES
from autotuner_sim import Fopdt, Pid, find_limit_cycle, run_parallel_relay, symmetric_relay

if TYPE_CHECKING:
    from autotuner.core.design import PidGains
    from autotuner_models.report import Cell

TABLE = TABLES[0]
ONLINE = "Kumar et al. (online)"
COMPARED = "ziegler_nichols_pid"
"""The controller whose figures are held against the printed ones."""
RULES = ("ziegler_nichols_p", "ziegler_nichols_pi", COMPARED)
PRINTED_WITHIN = 0.01
"""Relative difference from the printed figures above which the row is not reproduced."""
END_S, STEP_S = 150.0, 0.01


def online_table() -> ReportTable:
    """Return the describing function's results with three controllers, and the printed row."""
    plant = Fopdt(**TABLE.truth)
    printed = {name: float(figure) for name, figure in TABLE.row(ONLINE).printed.items()}
    controllers = _controllers(plant)
    found = {rule: _identified(plant, gains) for rule, gains in controllers.items()}
    return ReportTable(
        "online",
        "Online row of table 2.1: describing function of a relay beside a controller",
        (
            Column("controller", "controller"),
            *(Column(name, name, ".4g") for name in ("Kp", "Ti", "Td", "T")),
            Column("T_error_percent", "error %", "+.2f"),
            Column("D", "D", ".4g"),
            Column("D_error_percent", "error %", "+.2f"),
        ),
        (
            *((rule, *_gains(gains), *_figures(found[rule])) for rule, gains in controllers.items()),
            ("printed, gains not stated", None, None, None, *_figures(printed)),
        ),
        note="The bias shrinks with the relay's share of N + Gc; the relay alone gives T 18.8 % low.",
        failures=tuple(
            f"table 2.1, online: {name} is {found[COMPARED][name]:.4g}, printed {figure:g}"
            for name, figure in printed.items()
            if abs(found[COMPARED][name] / figure - 1.0) > PRINTED_WITHIN
        ),
    )


def _controllers(plant: Fopdt) -> dict[str, PidGains]:
    cycle = find_limit_cycle(plant, symmetric_relay(H))
    N, _ = ultimate_point(H, cycle.peak, cycle.period_s)
    measured = UltimatePoint(abs(N), cycle.period_s)
    return {rule: apply_rule(rule, ultimate=measured).gains for rule in RULES}


def _identified(plant: Fopdt, gains: PidGains) -> dict[str, float]:
    run = run_parallel_relay(plant, symmetric_relay(H), Pid(gains.Kp, gains.Ti, gains.Td, gains.Tf), END_S, STEP_S)
    controller = online_relay.held_response(gains, run.period_s, 0.0)
    return fopdt(plant.K, H, run.peak, run.period_s, controller=controller).parameters()


def _gains(gains: PidGains) -> tuple[Cell, ...]:
    return gains.Kp, gains.Ti if math.isfinite(gains.Ti) else None, gains.Td


def _figures(found: dict[str, float]) -> tuple[Cell, ...]:
    return tuple(cell for name in ("T", "D") for cell in (found[name], percent_off(found[name], TABLE.truth[name])))
