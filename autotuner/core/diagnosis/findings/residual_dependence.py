"""Dependence of an unexplained residual on single variables.

    e = pv - simulated,   e ~ polynomial of one variable x (degree 1 to 3), fitted to e on the fitted part
    share = 1 - sum (e - polynomial)^2 / sum (e - mean)^2   on the selection part,   over 1 - noise^2/var e

Variables: the output, its last move (with its direction), the PV, its slope, the time, and the hour of the day where
the record lasts longer than a day. Time cannot be extrapolated: its polynomial is fitted to every second tenth of
fitted and selection part together, and judged on the others. A share is that of one variable alone, so shares do not
add up. (Sobol' first-order indices, here of a residual: Math. Comput. Simul. 55, 2001.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import SMALLEST_DIVISOR

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import BoolArray, FloatArray

SHAPES = {1: "in proportion", 2: "like its square", 3: "like its cube"}
BETTER = 0.05
"""Increase of the share for a higher degree to be reported."""
WORTH_SAYING = 0.15
"""Share from which a variable is reported."""
DAY_S, TENTHS = 86400.0, 10
NOTHING_ALONE = (
    "what is missing depends on none of output, moves, PV, slope and time by itself: record what else acts on the "
    "process as further columns"
)
MEASURE = {
    "output": "a staircase of small steps over the whole range of the output",
    "last move of the output": "the same steps upward and downward, of several sizes",
    "PV": "the same steps of the output about another PV",
    "slope of the PV": "a record with synchronous time stamps, and steps of several speeds",
    "time": "a longer record at rest, with temperatures and flows of the surroundings as further columns",
    "hour of the day": "a record of several days, with the ambient temperature as a further column",
}
"""Measurement that would show more, by variable."""


@dataclass(frozen=True, slots=True)
class Dependence:
    """Dependence of the residual on one variable.

    Attributes
    ----------
    variable : str
        The variable.
    share : float
        Share of the residual that depends on it alone, 0 to 1, on held-out samples.
    shape : str
        Growth of the residual with it.
    """

    variable: str
    share: float
    shape: str

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {"variable": self.variable, "share": self.share, "shape": self.shape}


def dependences(context: FitContext, candidate: Fitted, noise: float) -> tuple[Dependence, ...]:
    """Return the dependences of a model's residual, the largest share first; empty for a residual of noise.

    Parameters
    ----------
    context : FitContext
        The record up to its test part.
    candidate : Fitted
        The model.
    noise : float
        Standard deviation of the noise, PV.
    """
    dataset = context.dataset
    rows = np.flatnonzero(dataset.fitted | dataset.held_out)
    residual = dataset.data.pv[rows] - candidate.simulated(rows)
    fitted = dataset.fitted[rows]
    left = residual[~fitted]
    missing = 1.0 - noise**2 / max(float(np.var(left)), SMALLEST_DIVISOR) if left.size else 0.0
    if missing <= 0.0:
        return ()
    tenth = np.minimum(np.arange(rows.size) * TENTHS // rows.size, TENTHS - 1)
    found = []
    for name, values in _variables(context, rows).items():
        learned: BoolArray = tenth % 2 == 0 if name == "time" else fitted
        if np.ptp(values[learned]) > 0.0:
            share, shape = _share(values, residual, learned)
            found.append(Dependence(name, float(min(max(share / missing, 0.0), 1.0)), shape))
    return tuple(sorted(found, key=lambda d: -d.share))


def in_words(found: tuple[Dependence, ...]) -> list[str]:
    """Return the dependences in words, and the measurement that would show more."""
    reported = [d for d in found if d.share > WORTH_SAYING]
    if not found:
        return []
    if not reported:
        return [NOTHING_ALONE]
    words = [
        f"{d.share:.0%} of what is missing depends on the {d.variable} alone and grows {d.shape}" for d in reported[:2]
    ]
    return ["; ".join(words) + f"; {MEASURE[reported[0].variable]} would show more"]


def _variables(context: FitContext, rows: np.ndarray) -> dict[str, FloatArray]:
    dataset = context.dataset
    held, t = dataset.data.held, dataset.data.t[rows]
    at = np.maximum(np.searchsorted(held.times, t, side="right") - 1, 0)
    pv = dataset.data.pv
    variables = {
        "output": held.levels[at],
        "last move of the output": held.steps[at],
        "PV": pv[rows],
        "slope of the PV": np.gradient(pv, dataset.data.t)[rows],
        "time": t,
    }
    if t[-1] - t[0] > DAY_S:
        variables["hour of the day"] = np.mod(t, DAY_S)
    return variables


def _share(values: FloatArray, residual: FloatArray, learned: BoolArray) -> tuple[float, str]:
    """Return the explained share of the best polynomial on held-out samples, and its shape."""
    x = (values - values[learned].mean()) / max(float(np.std(values[learned])), SMALLEST_DIVISOR)
    x = np.clip(x, x[learned].min(), x[learned].max())
    others = residual[~learned] - residual[~learned].mean()
    whole = max(float(others @ others), SMALLEST_DIVISOR)
    best, shape = 0.0, SHAPES[1]
    levels = np.unique(x[learned]).size
    for degree, words in SHAPES.items():
        if degree >= levels:
            break
        powers = np.vander(x, degree + 1)
        curve = powers[~learned] @ np.linalg.lstsq(powers[learned], residual[learned], rcond=None)[0]
        left = others - (curve - curve.mean())
        share = 1.0 - float(left @ left) / whole
        if share > best + BETTER:
            best, shape = share, words
    return best, shape
