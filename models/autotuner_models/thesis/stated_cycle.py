"""The "Offline" rows of the thesis: from the amplitude and period that it states, or to those that it leaves out.

    forward    eqs. 3.5, 3.6, 3.13, 3.14, 3.22, 3.23 on the stated A and Pu
    backward   FOPDT   w D = pi - atan(w T),                  A = 4 h K/(pi sqrt(1 + (w T)^2))
               SOPDT   w D = pi - arg(1 - m w^2 + j n w),     A = 4 h K/(pi |1 - m w^2 + j n w|)

The thesis reads `A` as the peak of the wave for FOPDT and as its fundamental for SOPDT, as its numbers show. Tables 2.1
to 2.3 state neither amplitude nor period: `implied_cycle` returns the pair that their figures follow from. `h` relay
height (output), `K` PV/output, `D`, `T`, `Pu` s, `w = 2 pi/Pu`, `A` PV, zero to peak.
"""

from __future__ import annotations

import cmath
import itertools
import math
from typing import TYPE_CHECKING

from scipy.optimize import brentq

from autotuner_models.estimates import H, by_describing_function
from autotuner_models.thesis.marks import half_digit
from autotuner_sim import PLANTS, find_limit_cycle, symmetric_relay

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner_models.thesis.printed import ThesisTable


def from_stated_cycle(table: ThesisTable, name: str) -> tuple[float, float, float]:
    """Return our figure on the stated `A` and `Pu`, and the least and greatest that their rounding allows."""
    A, Pu = table.misprint.right if table.misprint else table.A, table.Pu
    assert A is not None and Pu is not None  # noqa: S101, PT018 - asked for tables that state them

    def figure(A: float, Pu: float) -> float:
        return by_describing_function(table.structure, table.truth, A, Pu).parameters()[name]

    a, p = half_digit(A), half_digit(Pu)
    corners = [figure(float(A) + i * a, float(Pu) + j * p) for i, j in itertools.product((-1, 1), repeat=2)]
    return figure(float(A), float(Pu)), min(corners), max(corners)


def implied_cycle(K: float, D: float, m: float, n: float) -> tuple[float, float]:
    """Return the `A` and `Pu` from which the describing function gives `K e^{-Ds}/(m s^2 + n s + 1)`; FOPDT has m 0."""

    def denominator(w: float) -> complex:
        return complex(1.0 - m * w * w, n * w)

    def phase_lag(w: float) -> float:
        return w * D + cmath.phase(denominator(w)) - math.pi

    w = float(brentq(phase_lag, 1e-9, math.pi / D, xtol=1e-15))
    return 4.0 * H * K / (math.pi * abs(denominator(w))), 2.0 * math.pi / w


def exact_figures(table: ThesisTable) -> tuple[dict[str, float], float, float]:
    """Return the describing function's model of the exact cycle, and the amplitude and period it is read from."""
    cycle = find_limit_cycle(PLANTS[table.structure](**table.truth), symmetric_relay(H))
    A = cycle.peak if table.structure == "fopdt" else cycle.fundamental
    return by_describing_function(table.structure, table.truth, A, cycle.period_s).parameters(), A, cycle.period_s


def second_order_of(values: Mapping[str, float]) -> tuple[float, float]:
    """Return `m` and `n` of parameters of any of the thesis's structures."""
    if "T" in values:
        return 0.0, values["T"]
    if "T1" in values:
        return values["T1"] * values["T2"], values["T1"] + values["T2"]
    return values["m"], values["n"]
