"""How late the samples of a tuning came, for whoever asks often.

Rule of this file: while a tuning runs, the last `SHARE` of its samples may be missing, so that asking mostly costs
nothing; at its end all are counted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.recording import Sample

SHARE = 0.01
"""New samples with which it is computed again, of those before."""


@dataclass(slots=True)
class Lateness:
    """Lateness of the samples seen so far."""

    _late: FloatArray = field(default_factory=lambda: np.empty(0))
    _told: dict[str, float] | None = None

    def of(self, samples: Sequence[Sample], *, ended: bool) -> dict[str, float] | None:
        """Return median, 99th percentile and largest, s; None without a sample.

        Parameters
        ----------
        samples : sequence of Sample
            Those of the last time, and what came since.
        ended : bool
            Whether none is to come.
        """
        new = samples[self._late.size :]
        if new and (ended or len(new) >= SHARE * self._late.size):
            self._late = np.append(self._late, [sample.lateness_s for sample in new])
            p50, p99, largest = np.percentile(self._late, (50.0, 99.0, 100.0))
            self._told = {"p50_s": float(p50), "p99_s": float(p99), "max_s": float(largest)}
        return self._told
