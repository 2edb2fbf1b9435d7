"""Tunings of earlier runs of the service: results that follow from their recordings are recomputed on request.

Invariant: the same recording gives the same analysis (`autotuner replay` proves it), so nothing is guessed.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import TYPE_CHECKING

from autotuner.application.analysis.analysed import context_from
from autotuner.application.computing.computations import analyse

if TYPE_CHECKING:
    from autotuner.application.analysis.analysed import Analysis
    from autotuner.service.archive.archived_tuning import ArchivedTuning
    from autotuner.service.operations.compute_queue import ClientComputations

REMEMBERED = 8
"""Analyses that are remembered; the ones not requested for longest go first."""


class Analyses:
    """The analyses of past tunings that were requested lately; one at a time is computed."""

    def __init__(self) -> None:
        self._known: OrderedDict[str, Analysis] = OrderedDict()
        self._turn = asyncio.Lock()

    async def of(self, tuning: ArchivedTuning, computations: ClientComputations) -> Analysis | None:
        """Return the analysis of a tuning; None where it was not analysed."""
        if "estimates" not in tuning.kept.reported:
            return None
        async with self._turn:
            if tuning.id not in self._known:
                structure = tuning.kept.head.request["structure"]
                context = context_from(tuning.kept.reported.get("context"))
                self._known[tuning.id] = await computations.run(
                    analyse, tuning.recording(), structure, tuning.spec, context
                )
            self._known.move_to_end(tuning.id)
            while len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
            return self._known[tuning.id]
