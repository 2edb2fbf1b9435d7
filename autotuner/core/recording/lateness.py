"""Lateness of a tuning's samples, cheap enough for frequent requests.

Invariant: the largest is of all samples. While a tuning runs, the last `SHARE` of them may be missing in the
percentiles, so that asking mostly costs nothing; at its end all are counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.recording import Sample

SHARE = 0.1
"""New samples with which the percentiles are computed again, of those before."""


@dataclass(slots=True)
class Lateness:
    """Lateness of the samples so far."""

    _at: tuple[int, int, dict[str, float] | None] = (0, 0, None)
    """Samples counted for the largest and for the percentiles, and the reported figures: replaced as a whole."""

    def of(self, samples: Sequence[Sample], *, ended: bool) -> dict[str, float] | None:
        """Return median, 99th percentile and largest, s; None without a sample.

        Parameters
        ----------
        samples : sequence of Sample
            Samples of the last call, and new ones.
        ended : bool
            Whether no further sample follows.
        """
        start, counted, published = self._at
        new = [sample.lateness_s for sample in samples[start:]]
        count = start + len(new)
        if count == 0 or not (new or (ended and count > counted)):
            return published
        largest = max(new + ([published["max_s"]] if published else []))
        if published is None or ended or count >= (1.0 + SHARE) * counted:
            p50, p99 = np.percentile([sample.lateness_s for sample in samples[:count]], (50.0, 99.0))
            published, counted = {"p50_s": float(p50), "p99_s": float(p99)}, count
        published = {**published, "max_s": largest}
        self._at = count, counted, published
        return published
