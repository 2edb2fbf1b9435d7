"""Repairs of a recording before the diagnosis, and refusals of recordings that cannot be repaired.

gap       t_k+1 - t_k > 10 times its median, at a few places:  the longest part between gaps is used
swapped   the PV has few levels and jumps between them, the output never repeats a value, and a lag driven by
          the PV explains the output:  refused. A PV that passes none of its levels is that of a coarse sensor in a
          loop, whose controller follows it as a process would; so is one that a recorded set point is near
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.identification.advice import FEW_VALUES
from autotuner.core.recording import Recording
from autotuner.core.signals.feedback import is_kept_at_set_point
from autotuner.errors import RecordingError

GAP, MOST_GAPS = 10.0, 5
"""Length of a gap in usual sample intervals, and the most gaps: more are the normal sampling of the record."""
STANDING, MOVING, LEVELS = 0.8, 0.5, 60
"""Shares of samples at which a swapped PV does not change and a swapped output moves, and most levels of such a PV."""
EXPLAINED = 0.3
"""Misfit over the deviation of a signal under which a process explains it."""


def require_not_swapped(recording: Recording) -> None:
    """Refuse a recording whose columns are exchanged.

    Raises
    ------
    RecordingError
        Output and PV are swapped.
    """
    if not is_kept_at_set_point(recording) and _looks_swapped(recording) and _explains(recording):
        raise RecordingError(
            "output and PV look swapped: the PV jumps between few levels and drives the output",
            field="recording",
            remedy="Exchange the two columns.",
        )


def _looks_swapped(recording: Recording) -> bool:
    moves, answers = np.diff(recording.output) != 0.0, np.diff(recording.pv) != 0.0
    levels, at = np.unique(recording.pv, return_inverse=True)
    passes_none = levels.size > FEW_VALUES and np.abs(np.diff(at)).max() <= 1
    few = levels.size <= LEVELS and not passes_none
    return bool(few and moves.mean() > MOVING and answers.mean() < 1.0 - STANDING)


def _explains(recording: Recording) -> bool:
    """Return whether a process driven by the PV explains the output."""
    exchanged = Recording(recording.t, recording.pv, recording.output)
    base = base_of(bench_of(dataset_of(exchanged)), ("offset", "state"), 0)
    return base is not None and base.best.rms < EXPLAINED * float(np.std(recording.output))


def without_gaps(recording: Recording) -> Recording:
    """Return the longest part of a recording between its gaps, with a note on the omitted parts."""
    between = np.diff(recording.t)
    gaps = np.flatnonzero(between > GAP * recording.sample_interval_s)
    if not 0 < gaps.size <= MOST_GAPS or "restarts_s" in recording.settings:
        return recording
    edges = np.concatenate(([0], gaps + 1, [recording.t.size]))
    longest = int(np.argmax(np.diff(edges)))
    first, end = int(edges[longest]), int(edges[longest + 1])
    where = ", ".join(f"{recording.t[k]:.4g} s" for k in gaps)
    note = f"nothing was recorded for a while after {where}: samples {first} to {end - 1}, the longest part, were used"
    settings = recording.settings
    if first > 0:
        settings = {name: value for name, value in settings.items() if name != "segments"}
    return replace(recording.part(slice(first, end)), settings=settings, notes=(*recording.notes, note))
