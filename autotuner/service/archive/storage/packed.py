"""Samples as bytes: rows of six little-endian float64, reproduced bit by bit."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.recording import Sample

if TYPE_CHECKING:
    from collections.abc import Sequence

FIELDS = ("t", "pv", "output", "set_point", "lateness_s", "written_s")
"""The numbers of a sample, in the order in which they are packed."""
_row = attrgetter(*FIELDS)


def pack(samples: Sequence[Sample]) -> bytes:
    """Return samples as bytes."""
    return np.array(list(map(_row, samples)), dtype="<f8").tobytes()


def unpack(packed: bytes) -> list[Sample]:
    """Return the samples that `pack` packed."""
    rows = np.frombuffer(packed, dtype="<f8").reshape(-1, len(FIELDS))
    return [Sample(**dict(zip(FIELDS, row, strict=True))) for row in rows.tolist()]


def packed_length(packed: bytes) -> int:
    """Return how many samples are packed."""
    return len(packed) // (8 * len(FIELDS))
