"""How a tuning is told: whole, in a list, and by its paths."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import quote

from autotuner.core.phases import Phase
from autotuner.core.verdict import Outcome
from autotuner.service import schemas
from autotuner.store.past import LOST

if TYPE_CHECKING:
    from autotuner.runtime.tuning import Tuning
    from autotuner.store.kept import Summary
    from autotuner.store.past import PastTuning

PREFIX = "/v1"


def told(tuning: Tuning | PastTuning) -> schemas.Tuning:
    """Return all that is known of a tuning."""
    return schemas.Tuning.model_validate({**tuning.to_dict(), "links": links(tuning.id, tuning.loop)})


def listed(tuning: Tuning) -> schemas.TuningSummary:
    """Return what a list shows of a tuning in memory."""
    return schemas.TuningSummary(
        id=tuning.id,
        loop=tuning.loop,
        state="ended" if tuning.ended else "running",
        phase=Phase(tuning.phase),
        started_at=tuning.started_at,
        outcome=tuning.verdict.outcome if tuning.verdict else None,
        code=tuning.verdict.code if tuning.verdict else None,
        links=links(tuning.id, tuning.loop),
    )


def listed_past(tuning: Summary) -> schemas.TuningSummary:
    """Return what a list shows of a tuning of an earlier run; one whose end is not kept was interrupted."""
    return schemas.TuningSummary(
        id=tuning.id,
        loop=tuning.loop,
        state="ended",
        phase=Phase(tuning.phase),
        started_at=tuning.started_at,
        outcome=Outcome(tuning.outcome or LOST.outcome),
        code=tuning.code or LOST.code,
        links=links(tuning.id, tuning.loop),
    )


def path_of(tuning_id: str) -> str:
    """Return the path of a tuning."""
    return f"{PREFIX}/tunings/{quote(tuning_id, safe='')}"


def links(tuning_id: str, loop: str) -> schemas.Links:
    """Return the paths of a tuning and of what can be done with it."""
    path = path_of(tuning_id)
    parts = ("events", "recording", "report", "export", "abort", "gains", "apply", "verify", "rollback")
    return schemas.Links(
        self=path, loop=f"{PREFIX}/loops/{quote(loop, safe='')}", **{part: f"{path}/{part}" for part in parts}
    )
