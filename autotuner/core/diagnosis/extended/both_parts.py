"""What is reported of a model: its numbers as fitted to the fitted and the selection part together.

An explanation is chosen by its error on the selection part, which must not have been fitted until then. Afterwards
that part says as much about the numbers as the fitted one does, and lies closer to what follows.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.fit_context import MOST_SAMPLES, thinned
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.seen_again import as_seen_again

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

STEPS = 30
"""Most steps of the optimiser from the numbers of the fitted part, which are near."""


@lru_cache(maxsize=32)
def to_both_parts(context: FitContext, fitted: Fitted) -> Fitted:
    """Return a model fitted to both parts together; itself where that leads elsewhere. Cached.

    A tuning's tail is no experiment: it has few moves, and is not fitted.
    """
    if fitted.problem.dataset is not context.dataset or context.dataset.tuned:
        return fitted
    rows = np.flatnonzero(context.dataset.fitted | context.dataset.held_out)
    seen = as_seen_again(fitted, context.dataset, context.dataset.data.t.size)
    again = fit(replace(seen.problem, rows=thinned(rows, MOST_SAMPLES)), seen.theta, STEPS)
    return again if is_physical(again) else fitted
