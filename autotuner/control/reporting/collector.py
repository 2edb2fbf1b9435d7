"""The collector of reference cycles, kept short while loops are tuned.

A full collection looks through everything that is held, in one step during which no other thread runs: with the
samples of fifty tunings a tenth of a second and more. What is put aside by `gc.freeze` is not looked through.

A collection of what is young comes after so many new objects, and a thousand loops have more than the usual number of
them at any time: an object of each wait and request under way is looked through that is about to go by itself.

Rules of this file:

1. While a tuning runs, what is held is put aside every `PERIOD_S`: a collection looks through what came since. Between
   two of these, one comes by itself only after `YOUNG` objects.
2. When none runs any more, all of it is looked through once: what has become rubbish meanwhile goes.
"""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

PERIOD_S = 0.5
"""Time after which new objects are put aside while a tuning runs, s: it bounds what one collection looks through."""
YOUNG = 50_000
"""New objects after which a collection comes by itself while a tuning runs."""


class Collector:
    """Takes turns with the automatic collections.

    Parameters
    ----------
    busy : callable
        Returns whether a tuning runs.
    """

    def __init__(self, busy: Callable[[], bool]) -> None:
        self._busy = busy
        self._aside = False
        self._young, *self._older = gc.get_threshold()

    def look(self) -> None:
        """Put aside what is held, or look through it; called every `PERIOD_S`."""
        busy = self._busy()
        if busy or self._aside:
            gc.set_threshold(YOUNG if busy else self._young, *self._older)
            if not busy:
                gc.unfreeze()
            gc.collect()
            gc.freeze()
        self._aside = busy
