"""Candidates for the undefined column "% Error" of tables 2.3 and 5.4: measures of a whole model.

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

from autotuner_models.thesis.stated_cycle import second_order_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from autotuner_models.thesis.printed import Row, ThesisTable

    Numbers = NDArray[np.float64]

WINDOW_S = 16.6
"""Window of the step response at which the first and third row of table 2.3 come out."""
POINTS = 4000
"""Points of an integral over frequency or time."""


def tried(table: ThesisTable, row: Row) -> dict[str, float]:
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
