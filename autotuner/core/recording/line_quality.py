"""Quality of the line to the device in a record, as warnings.

    slow       d > SLOW T                 d: median time between two samples, T: the requested sample time
    missing    1 + L/d - n >= FEW L/d     n samples over L seconds; a line that keeps its pace brings 1 + L/d
    repeated   r > OFTEN n                r: requests that were answered only when they were repeated
    damaged    any                        readings that the next ones contradicted
    stale      c > p + 4 sqrt(2 p)        c: readings that are equal to the last digit to the one before, in at least
               and c >= p + FEW n         FEWEST_MISSING places; p = m/2 exp(q^2/4 s^2), by chance: m differ by the
               and s >= q                 resolution q, and the noise s is larger than that
               a = (1 - p/c) d sum l(l - 1)/(2 n)   their mean age, added to the dead time; l: length of a row

A slow or lossy line does not show in the model: the intervals account for the noise of the PV, not for an
output that acted earlier than its confirmation.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording.recording import Sample

SLOW: Final = 1.5
"""Median interval over the requested sample time, from which a line is slow."""
FEW: Final = 0.02
"""Share of samples missing, or taken again, from which a line is reported."""
OFTEN: Final = 0.005
"""Share of requests answered only when repeated, from which a line is reported."""
FEWEST_MISSING: Final = 3
"""Fewest missing samples that are reported, in records so short that a share means little."""
CERTAIN: Final = 4.0
"""Standard deviations of a Poisson count beyond which repeats are no chance: once in 30,000."""
OF_SECOND_DIFFERENCES: Final = 0.6745 * math.sqrt(6.0)
"""Median absolute second difference of a white noise, in its standard deviation."""
NAMED: Final = 3
"""Damaged readings that are named one by one."""
FEWEST: Final = 20
"""Fewest samples from which a pace is estimated."""


def line_warnings(
    samples: Sequence[Sample], sample_time_s: float, repeated: int, damaged: Sequence[str] = ()
) -> list[str]:
    """Return the notes on the line.

    Parameters
    ----------
    samples : sequence of Sample
        The record.
    sample_time_s : float
        Requested time between two samples, s.
    repeated : int
        How many requests were answered only when they were repeated.
    damaged : sequence of str
        Values of mode, set point and output that the next readings did not confirm.
    """
    if len(samples) < FEWEST:
        return _damaged(damaged)
    steps_s = np.diff([sample.t for sample in samples])
    pace_s = float(np.median(steps_s))
    warnings = [
        _slow(pace_s, sample_time_s),
        _missing(len(samples), float(steps_s.sum()), float(steps_s.max()), pace_s),
        _repeated(repeated, len(samples)),
        _stale(np.array([sample.pv for sample in samples]), pace_s),
    ]
    return [*(text for text in warnings if text), *_damaged(damaged)]


def _damaged(readings: Sequence[str]) -> list[str]:
    if not readings:
        return []
    more = f"; and {len(readings) - NAMED} more" if len(readings) > NAMED else ""
    text = (
        f"damaged readings, {len(readings)} in all, contradicted by later ones: {'; '.join(readings[:NAMED])}"
        f"{more}; inspect the line and the device: a damaged PV cannot be distinguished from a true one"
    )
    return [text]


def _slow(pace_s: float, sample_time_s: float) -> str:
    if pace_s <= SLOW * sample_time_s:
        return ""
    return (
        f"samples came every {pace_s:.3g} s, not every {sample_time_s:g} s: the line is too slow; set "
        f"sample_time_s to {1.2 * pace_s:.2g}, or use fewer requests in a sample (adjacent registers)"
    )


def _missing(samples: int, lasted_s: float, longest_s: float, pace_s: float) -> str:
    expected = round(lasted_s / pace_s) + 1
    if expected - samples < max(FEW * expected, FEWEST_MISSING):
        return ""
    return (
        f"{expected - samples} of {expected} samples are missing, for {longest_s:.3g} s at the longest: the line or "
        "the device did not answer; check both before the gains are relied on"
    )


def _repeated(repeated: int, samples: int) -> str:
    if repeated <= OFTEN * samples:
        return ""
    return (
        f"{repeated} requests in {samples} samples were answered only when they were repeated: the line loses or "
        "damages messages; an output may have acted earlier than recorded, by timeout_s at most"
    )


def _stale(pv: FloatArray, pace_s: float) -> str:
    """Report repeated answers: a PV in noise does not return to the same last digit."""
    steps = np.abs(np.diff(pv))
    resolution = float(steps[steps > 0.0].min(initial=math.inf))
    sigma = float(np.median(np.abs(np.diff(pv, 2)))) / OF_SECOND_DIFFERENCES
    if sigma < resolution:
        return ""
    rows = np.diff(np.flatnonzero(np.concatenate(([True], steps > 0.0, [True]))))
    neighbours = np.count_nonzero((steps > 0.0) & (steps < 1.5 * resolution))
    again, by_chance = int(np.sum(rows - 1)), neighbours / 2.0 * math.exp((resolution / sigma) ** 2 / 4.0)
    enough = by_chance + max(CERTAIN * math.sqrt(2.0 * by_chance), FEW * pv.size)
    if again <= enough or np.sum(rows > 1) < FEWEST_MISSING + by_chance:
        return ""
    age_s = (1.0 - by_chance / again) * pace_s * float(np.sum(rows * (rows - 1.0))) / (2.0 * pv.size)
    return (
        f"{again} of {pv.size} readings of the PV equal the one before to the last digit, where noise would make "
        f"{by_chance:.0f} of them equal: the device or the line answers with an earlier reading, {age_s:.2g} s old on "
        "the mean; the dead time found is longer by that, and the intervals do not know of it: sample more slowly, or "
        "check the line"
    )
