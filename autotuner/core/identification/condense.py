"""Very long recordings, brought down to what the arithmetic can do in bounded time and memory.

Every k-th sample is kept, and with it every sample at which the output changes and the one before, so that no move is
displaced. An output that changes too often for that is replaced by its mean over each k samples, which moves the
process as it does.
"""

from __future__ import annotations

import math

import numpy as np

from autotuner.core.recording import Recording

MOST_SAMPLES = 20_000


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
    return Recording(
        recording.t[rows],
        output,
        recording.pv[rows],
        None if recording.set_point is None else recording.set_point[rows],
        {name: values[rows] for name, values in recording.extra.items()},
        recording.settings,
        (*recording.notes, note),
        written_s,
    )
