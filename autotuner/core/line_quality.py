"""What the line to the device did to a record, as warnings.

    slow       d > SLOW T                 d: median time between two samples, T: the sample time asked for
    missing    1 + L/d - n >= FEW L/d     n samples over L seconds; a line that keeps its pace brings 1 + L/d
    repeated   r > OFTEN n                r: requests that were answered only when they were repeated

A line that is slow or loses answers does not show in the model: the intervals know the noise of the PV, not that an
output may have come earlier than it was confirmed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.recording import Sample

SLOW: Final = 1.5
FEW: Final = 0.02
OFTEN: Final = 0.005
FEWEST_MISSING: Final = 3
FEWEST: Final = 20
"""Samples from which a pace can be told."""


def line_warnings(samples: Sequence[Sample], sample_time_s: float, repeated: int) -> list[str]:
    """Return what is to be said of the line.

    Parameters
    ----------
    samples : sequence of Sample
        The record.
    sample_time_s : float
        Time between two samples that was asked for, s.
    repeated : int
        How many requests were answered only when they were repeated.
    """
    if len(samples) < FEWEST:
        return []
    steps_s = np.diff([sample.t for sample in samples])
    pace_s = float(np.median(steps_s))
    told = [
        _slow(pace_s, sample_time_s),
        _missing(len(samples), float(steps_s.sum()), float(steps_s.max()), pace_s),
        _repeated(repeated, len(samples)),
    ]
    return [text for text in told if text]


def _slow(pace_s: float, sample_time_s: float) -> str:
    if pace_s <= SLOW * sample_time_s:
        return ""
    return (
        f"samples came every {pace_s:.3g} s, not every {sample_time_s:g} s: the line carries no more; set "
        f"sample_time_s to {1.2 * pace_s:.2g}, or have fewer requests a sample (registers side by side)"
    )


def _missing(samples: int, lasted_s: float, longest_s: float, pace_s: float) -> str:
    expected = round(lasted_s / pace_s) + 1
    if expected - samples < max(FEW * expected, FEWEST_MISSING):
        return ""
    return (
        f"{expected - samples} of {expected} samples are missing, for {longest_s:.3g} s at the longest: the line or "
        "the device did not answer; look at both before the gains are relied on"
    )


def _repeated(repeated: int, samples: int) -> str:
    if repeated <= OFTEN * samples:
        return ""
    return (
        f"{repeated} requests in {samples} samples were answered only when they were repeated: the line loses or "
        "damages messages; an output may have come earlier than the record says, by timeout_s at most"
    )
