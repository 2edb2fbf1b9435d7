"""The process of a closed loop that an unmeasured load moves about as much as the set point does.

    pv = G u + e,   e_k = a_1 e_{k-1} + ... + a_p e_{k-p} + w_k,   minimise sum_k w_k^2 over G and a

The error of simulation, `e`, is least between the process and the inverse of the controller, because the load has
moved the output, too: such a fit often has the wrong sign. The error of prediction, `w`, is least at the process itself
where the record determines it: the set point has to move. (Ljung, System Identification, 1999, ch. 13.4.)

That has many minima, too. The search begins with the memory that a regression on past readings and outputs leaves,
which has one minimum only, and goes on as in `prewhitening`; the criterion chooses among the structures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.estimation.backgrounds import PRICE, floor_of
from autotuner.core.estimation.data import ANY_GAIN
from autotuner.core.estimation.initial_guesses import Start, delays_of
from autotuner.core.estimation.least_squares import candidate_of, fit
from autotuner.core.estimation.noise.ar_noise import SAMPLES_EACH, Coloured, even_runs, memory_of
from autotuner.core.estimation.optimiser import best_delay, best_of, refine
from autotuner.core.estimation.prewhitening import criterion_of, is_even, with_memory
from autotuner.core.model.structures import FOPDT, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.estimation.noise.ar_noise import Memory
    from autotuner.core.model.structures import Structure

SWINGS_ON = 0.8
"""Share of an oscillation left after a period from which on it is no noise. The memory of load and sensor together
needs many coefficients, some of which swing; of a limit cycle, more is left."""
READINGS, OUTPUTS = 12, 40
"""Past readings and outputs of the regression with which the search beside a large load begins."""
SECOND = (0.05, 0.25, 1.0)
"""Ratios of the numbers of a pair to start from, `(m/n)/n`: damping ratios of 2.2, 1 and 0.5."""
RUNS_AWAY = 10.0
"""Answer of that regression, over the range of the PV, which no stable process gives."""
LAGS, LONGEST_LAG = 12, 0.25
"""Lags from which that search starts, up to the longest as a share of the record."""


def with_disturbance(
    candidates: Sequence[Candidate], allowed: Sequence[Structure], data: Data, prior: GainPrior = ANY_GAIN
) -> Candidate | None:
    """Return the fitted structure that predicts best beside an autoregressive disturbance; None where none explains it.

    Parameters
    ----------
    candidates : sequence of Candidate
        What plain least squares found, the best first: the search starts from these, and from a grid.
    allowed : sequence of Structure
        What may be the answer.
    data : Data
        The recording, of a closed loop.
    prior : GainPrior
        Prior knowledge of the static gain.
    """
    memory = _memory_of_the_load(data) if is_even(data) else None
    if memory is None or not memory.order:
        return None
    lags = _of_lags(replace(data, coloured=Coloured.of(memory, data.t, data.weight)), prior)
    starts = [start for start in (*lags, *candidates) if start.structure in allowed]
    found = [other for start in starts if (other := with_memory(start, data, prior, SWINGS_ON))]
    return min(found, key=lambda c: criterion_of(c.solution) + PRICE * c.solution.theta.size, default=None)


def _of_lags(data: Data, prior: GainPrior) -> list[Candidate]:
    """Return one lag and a pair of them where the innovations are least: of all lags and dead times of a grid."""
    lags, delays = np.geomspace(data.interval_s, LONGEST_LAG * data.span_s, LAGS), delays_of(data).tolist()
    starts = [best_delay(data, FOPDT, ("offset",), Start((lag,), 0.0, 0.0), delays, prior) for lag in lags.tolist()]
    single = best_of([refine(data, FOPDT, ("offset",), start, prior) for start in starts], prior)
    found = candidate_of(single, prior, 0, floor_of(data))
    pair = None if found is None else fit(data, SECOND_ORDER, prior, 0.0, _as_pairs(single.start))
    return [candidate for candidate in (found, pair) if candidate is not None and candidate.resolved]


def _as_pairs(single: Start) -> tuple[Start, ...]:
    """Return pairs, from one of a short second lag to one that rings, in place of a lag with a dead time."""
    (lag,) = single.shape
    return tuple(Start((lag, share * lag), max(single.delay_s - share * lag, 0.0), 0.0) for share in SECOND)


def _memory_of_the_load(data: Data) -> Memory | None:
    """Return the memory of what a regression on past readings and outputs leaves of the PV; None where that runs away.

    The regression is `pv_k = sum_i a_i pv_{k-i} + sum_j b_j u_{k-j} + c + w_k`, and leaves `pv - B/(1 - A) u`.
    """
    samples = data.t.size
    reach = min(READINGS, samples // SAMPLES_EACH), min(OUTPUTS, samples // SAMPLES_EACH)
    first = max(reach)
    if not first:
        return None
    u, pv = data.held.at(data.t - 0.5 * data.interval_s), data.pv
    past = [pv[first - i : samples - i] for i in range(1, reach[0] + 1)]
    past += [u[first - j + 1 : samples - j + 1] for j in range(1, reach[1] + 1)]
    columns = np.column_stack([*past, np.ones(samples - first)])
    a, b, _ = np.split(np.linalg.lstsq(columns, pv[first:], rcond=None)[0], np.cumsum(reach))
    recursion = np.outer(np.append(1.0, -a), np.ones(samples))  # the columns of 1 - A, banded and lower triangular
    left = pv - scipy.linalg.solve_banded((a.size, 0), recursion, np.convolve(u, b)[:samples])
    if not np.abs(left).max() < RUNS_AWAY * np.ptp(pv):
        return None
    return memory_of(left - left.mean(), np.zeros((samples, 0)), even_runs(data.t, data.weight))
