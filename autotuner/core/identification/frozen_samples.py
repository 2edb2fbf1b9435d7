"""Samples at which the sensor does not follow: at the end of its range, or frozen.

    at an end    the PV rests at its extreme for long, in runs, and is hardly ever close to it
    frozen       one value for a long run, where noise moves the PV from sample to sample elsewhere

They carry no measurement, so a fit without them is tried where the one with them leaves much unexplained; a process
that really rests there is fitted well with them, and keeps them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import BoolArray  # noqa: TC001 - part of the public signature
from autotuner.core.signals.static_gain import rest_rows

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording

SHARE = 0.05
"""Share of the samples at one extreme that makes a sensor at the end of its range likely."""
IN_RUNS, HARDLY_BESIDE = 0.8, 3.0
FEWEST_FROZEN, FROZEN_SHARE = 20, 0.05
"""Length of a constant run that is not chance, in samples and as a share of the record."""
RARE, TO_AND_FRO = 0.02, 0.3
"""Largest share of equal neighbours, and least of second differences that change sign, at which noise moves every
sample; those of white noise do at three quarters of the samples, those of a smooth PV hardly ever."""


@dataclass(frozen=True, slots=True, eq=False)
class Stuck:
    """Such samples.

    Attributes
    ----------
    rows : array of bool, shape (N,)
        Which they are.
    notes : tuple of str
        What there is to say of them.
    """

    rows: BoolArray
    notes: tuple[str, ...]


def stuck_rows(recording: Recording, resolution: float) -> Stuck | None:
    """Return the samples at which the sensor did not follow, or None where it always did.

    Parameters
    ----------
    recording : Recording
        The samples.
    resolution : float
        Smallest step of the PV.
    """
    rows, notes = np.zeros(len(recording), dtype=np.bool_), []
    for more, words in (*_frozen(recording), *_at_ends(recording, resolution)):
        if not rows[more].all():
            rows |= more
            notes.append(words)
    return Stuck(rows, tuple(notes)) if notes else None


def _at_ends(recording: Recording, resolution: float) -> list[tuple[BoolArray, str]]:
    begin = rest_rows(recording.output) + 1
    pv, found = recording.pv[begin:], []
    for name, extreme in (("highest", pv.max()), ("lowest", pv.min())) if pv.size else ():
        at = pv == extreme
        in_runs = float((at[1:] & at[:-1]).sum())
        beside = int((np.abs(pv - extreme) <= 1.5 * resolution).sum()) - int(at.sum())
        often = at.mean() > SHARE and in_runs > IN_RUNS * at.sum() and at.sum() > HARDLY_BESIDE * beside
        if often and extreme != recording.pv[0]:
            rows = np.concatenate((np.zeros(begin, dtype=np.bool_), at))
            found.append(
                (rows, f"the PV rests at its {name} value {extreme:g} for {at.mean():.0%} of the test: saturated?")
            )
    return found


def _frozen(recording: Recording) -> list[tuple[BoolArray, str]]:
    pv, t = recording.pv, recording.t
    begins = np.concatenate(([0], np.flatnonzero(np.diff(pv)) + 1))
    lengths = np.diff(np.append(begins, pv.size))
    long = (lengths >= FEWEST_FROZEN) & (lengths >= FROZEN_SHARE * pv.size)
    elsewhere = lengths[~long]
    if not long.any() or elsewhere.sum() < FEWEST_FROZEN or _equal_share(elsewhere) > RARE:
        return []
    bends = np.diff(pv[~np.repeat(long, lengths)], 2)
    if np.mean(bends[1:] * bends[:-1] < 0.0) < TO_AND_FRO:
        return []
    found = []
    for begin, length in zip(begins[long].tolist(), lengths[long].tolist(), strict=True):
        rows = np.zeros(pv.size, dtype=np.bool_)
        rows[begin : begin + length] = True
        words = (
            f"the PV stays at {pv[begin]:g} from {t[begin]:g} to {t[begin + length - 1]:g} s, while noise moves it "
            "elsewhere: is the sensor, or the line to it, frozen?"
        )
        found.append((rows, words))
    return found


def _equal_share(lengths: FloatArray) -> float:
    """Return the share of samples that equal the one before, of runs of such lengths."""
    return float((lengths - 1).sum()) / float(lengths.sum())
