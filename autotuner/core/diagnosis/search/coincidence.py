"""Detects a disturbance that begins or ends where a move of the output arrives, and may be an error of its response."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.diagnosis.record.dataset import Dataset

FEW_MOVES, NEAR, COINCIDENCE = 10, 2.0, 0.1
"""Most moves for which an event at the response to one is not distinguished from it; samples that coincide; the share
of the record that lies so near to a response that a coincidence is chance."""
LOAD, DRIFT = "load_step", "drift"
BEGINS, LASTS = ("at_s", "from_s"), "lasts_s"


def answers_a_move(sizes: Mapping[str, float], dataset: Dataset, delay_s: float, error_s: float = 0.0) -> bool:
    """Return whether a disturbance begins or ends with the answer to one of a few moves, which chance would hardly do.

    Parameters
    ----------
    sizes : mapping of str to float
        Sizes of the disturbance.
    dataset : Dataset
        The record.
    delay_s : float
        Dead time, s.
    error_s : float
        By how much its beginning may be off, s.
    """
    arrivals = dataset.data.held.times[1:] + delay_s
    near_s = max(NEAR * dataset.data.interval_s, error_s)
    begins = next((sizes[name] for name in BEGINS if name in sizes), math.inf)
    ends = [begins, begins + sizes[LASTS]] if LASTS in sizes else [begins]
    if not 0 < arrivals.size <= FEW_MOVES or 2.0 * near_s * arrivals.size * len(ends) >= COINCIDENCE * dataset.span_s:
        return False
    return any(float(np.abs(arrivals - end).min()) <= near_s for end in ends)
