"""Which tunings are kept: the newest, up to a number and a size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence


@dataclass(frozen=True, slots=True)
class Retention:
    """Limits of the archive.

    Attributes
    ----------
    tunings : int
        How many at most.
    size_bytes : int
        How much all of their recordings and events may take.
    """

    tunings: int
    size_bytes: int

    def surplus(self, sizes: Sequence[tuple[str, int]], running: Collection[str]) -> list[str]:
        """Return the tunings to forget; never one that runs, nor the newest.

        Parameters
        ----------
        sizes : sequence of (str, int)
            Identifier and bytes of every tuning, the newest first.
        running : collection of str
            Those that run.
        """
        gone, held = [], 0
        for place, (tuning_id, size) in enumerate(sizes):
            held += size
            if place and tuning_id not in running and (place >= self.tunings or held > self.size_bytes):
                gone.append(tuning_id)
        return gone
