"""Representations of a tuning: complete, in a list, and its links."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from autotuner.core.experiment.phases import Phase
from autotuner.core.jsonable import jsonable
from autotuner.core.verdict import Outcome
from autotuner.service.archive.archive_record import result_of
from autotuner.service.archive.archived_tuning import LOST, ArchivedTuning
from autotuner.service.schemas import resources

if TYPE_CHECKING:
    from autotuner.application.tuning_run import TuningRun
    from autotuner.service.archive.archive_record import Summary

PREFIX = "/v1"


def tuning_resource(tuning: TuningRun | ArchivedTuning) -> resources.Tuning:
    """Return the complete representation of a tuning."""
    current = not isinstance(tuning, ArchivedTuning)
    whole = {**tuning.to_dict(), "current": current, "links": links(tuning.id, tuning.loop)}
    return resources.Tuning.model_validate(whole)


def listed(tuning: TuningRun) -> resources.TuningSummary:
    """Return the list entry of a tuning in memory."""
    return resources.TuningSummary(
        id=tuning.id,
        loop=tuning.loop,
        state="ended" if tuning.ended else "running",
        phase=Phase(tuning.phase),
        started_at=tuning.started_at,
        outcome=tuning.verdict.outcome if tuning.verdict else None,
        code=tuning.verdict.code if tuning.verdict else None,
        actor=tuning.request.actor,
        **result_of(_found_by(tuning)),
        links=links(tuning.id, tuning.loop),
    )


def listed_archived(tuning: Summary) -> resources.TuningSummary:
    """Return the list entry of a tuning of an earlier run; one without an archived end was interrupted."""
    return resources.TuningSummary(
        id=tuning.id,
        loop=tuning.loop,
        state="ended",
        phase=Phase(tuning.phase),
        started_at=tuning.started_at,
        outcome=Outcome(tuning.outcome or LOST.outcome),
        code=tuning.code or LOST.code,
        actor=tuning.actor,
        **tuning.result,
        links=links(tuning.id, tuning.loop),
    )


def _found_by(tuning: TuningRun) -> dict[str, Any]:
    """Return the results of a tuning in memory for its list entry."""
    found, run = tuning.analysis, tuning.verification
    gains = found.gains if found else None
    return {
        "structure": found.identification.structure if found else None,
        "model": jsonable(dict(tuning.model.parameters())) if tuning.model else None,
        "gains": gains.gains.to_dict() if gains else None,
        "tuning": {"goal": gains.goal, "rule": gains.rule} if gains else None,
        "applied": tuning.applied,
        "verification": {"passed": run.passed} if run and run.verdict else None,
    }


def path_of(tuning_id: str) -> str:
    """Return the path of a tuning."""
    return f"{PREFIX}/tunings/{quote(tuning_id, safe='')}"


def links(tuning_id: str, loop: str) -> resources.Links:
    """Return the paths of a tuning and of its operations."""
    path = path_of(tuning_id)
    parts = ("events", "recording", "report", "export", "abort", "gains", "apply", "verify", "rollback")
    return resources.Links(
        self=path,
        loop=f"{PREFIX}/loops/{quote(loop, safe='')}",
        verification_events=f"{path}/verification/events",
        **{part: f"{path}/{part}" for part in parts},
    )
