"""Rows without a PV: harmless while the output rests, a hole in the record where it moves.

    lost = sum |u_k - u_a| dt_k over the rows of a hole,   u_a the output of the last row with a PV
    a hole counts when   lost > 0.02 sum |u_k - median u| dt_k over the record

What the process was told in such a hole cannot be followed from its edges, so only one side of it can be used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.arrays import BoolArray, FloatArray

COUNTS = 0.02


def longest_part(t: FloatArray, output: FloatArray, measured: BoolArray) -> tuple[slice, int]:
    """Return the rows of the longest part without a hole that counts, and how many such holes there are.

    Parameters
    ----------
    t, output : array of float, shape (N,)
        Times, s, and the output; NaN where it is not known.
    measured : array of bool, shape (N,)
        Which rows have a PV and an output.
    """
    everything = slice(0, t.size)
    if measured.all() or not measured.any():
        return everything, 0
    dt = np.append(np.diff(t), 0.0)
    before = np.maximum.accumulate(np.where(measured, np.arange(t.size), int(np.argmax(measured))))
    output = np.where(np.isfinite(output), output, np.nan)
    off = np.where(np.isfinite(output) & ~measured, np.abs(output - output[before]) * dt, 0.0)
    off[: int(np.argmax(measured))] = 0.0
    moved = float(np.nansum(np.abs(output - np.nanmedian(output)) * dt))
    lost = np.bincount(before, weights=off, minlength=t.size)
    edges = np.flatnonzero(lost > COUNTS * moved)
    if not edges.size:
        return everything, 0
    starts, ends = np.concatenate(([0], edges + 1)), np.append(edges + 1, t.size)
    count = np.concatenate(([0], np.cumsum(measured)))
    longest = int(np.argmax(count[ends] - count[starts]))
    return slice(int(starts[longest]), int(ends[longest])), int(edges.size)
