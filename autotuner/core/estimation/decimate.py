"""Decimation of very long recordings, for bounded time and memory of the computations.

Every k-th sample is kept, and with it every sample at which the output changes and the one before, so that no move is
displaced. An output that changes too often for that is replaced by its mean over each k samples, which moves the
process as it does.

A PV that has moved on between two samples kept, `r(k) < 0.8 r(1)` with the autocorrelation `r`, would be lost so. Then
a window is taken in which the samples lie close enough, where the output moves most.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording

MOST_SAMPLES = 20_000
"""Most samples of a fit: further ones narrow the intervals little, at a cost that grows with them."""
FOLLOWED = 0.8
"""Autocorrelation of the PV between two samples kept, over that of neighbours, from which it can be followed."""


def condensed(recording: Recording, most: int = MOST_SAMPLES) -> Recording:
    """Return the recording itself, or one of about `most` samples with a note of it.

    Parameters
    ----------
    recording : Recording
        Any recording.
    most : int
        Samples above which it is condensed.
    """
    size = len(recording)
    if size <= most:
        return recording
    step = math.ceil(size / most)
    close = _close_enough(recording.pv, step)
    if close < step:
        return condensed(_window(recording, most * close, step), most)
    rows = np.arange(0, size, step)
    output, written_s = recording.output, recording.written_s
    changes = np.flatnonzero(np.diff(output)) + 1
    if changes.size <= most // 2:
        rows = np.union1d(rows, (changes - 1, changes))
        output, written_s = output[rows], None if written_s is None else written_s[rows]
    else:
        written_s = None
        output = np.add.reduceat(output, rows) / np.diff(np.append(rows, size))
    note = f"{rows.size} of {size} samples were used: every {step}th, and those at which the output changed"
    return replace(recording.part(rows), output=output, written_s=written_s, notes=(*recording.notes, note))


def _close_enough(pv: FloatArray, step: int) -> int:
    """Return the step between samples at which the PV can be followed: `step`, or the first of its halves."""
    halves = [step]
    while halves[-1] > 1:
        halves.append((halves[-1] + 1) // 2)
    correlations = [_correlation(pv, lag) for lag in halves]
    # A periodic PV repeats after a full period: all shorter steps have to follow it as well.
    followed = [min(correlations[k:]) >= FOLLOWED * correlations[-1] for k in range(len(halves))]
    return next((lag for lag, enough in zip(halves, followed, strict=True) if enough), 1)


def _correlation(pv: FloatArray, lag: int) -> float:
    deviation = pv - pv.mean()
    power = float(deviation @ deviation)
    return float(deviation[lag:] @ deviation[:-lag]) / power if power > 0.0 else 1.0


def _window(recording: Recording, count: int, step: int) -> Recording:
    """Return the given number of consecutive samples with the largest moves of the output, with a note."""
    size = len(recording)
    travel = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(recording.output)))))
    begins = np.arange(0, size - count + 1, max(count // 4, 1))
    first = int(begins[np.argmax(travel[begins + count - 1] - travel[begins])])
    cause = f"the PV moves faster than every {step}th sample shows"
    note = f"{cause}: samples {first} to {first + count - 1} of {size} were used"
    settings = {name: value for name, value in recording.settings.items() if name != "segments"}
    return replace(recording.part(slice(first, first + count)), settings=settings, notes=(*recording.notes, note))
