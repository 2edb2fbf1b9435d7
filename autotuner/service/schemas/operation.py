"""Schemas for the operation of the service: health, links, audit, reload, problem types."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from autotuner.service.schemas.resources import Response


class Health(Response):
    """Whether the service runs."""

    status: Literal["ok"] = "ok"


class LoopLink(Response):
    """Whether the device of a loop answers; `error` is why not."""

    loop: str
    tuning_id: str | None = Field(description="The tuning that holds the loop.")
    link: Literal["up", "down", "unknown"] = Field(description="unknown: it has not been polled yet.")
    error: str | None


class Readiness(Response):
    """Readiness for tunings, and each loop's link."""

    status: Literal["ok", "degraded"] = Field(description="degraded: the device of some loop does not answer.")
    loops: list[LoopLink]


class AuditEntry(Response):
    """Entry of the audit, with the status of the answer; `actor`: name of a token, `local`, or `shell:` and a user."""

    number: int
    at: str
    actor: str
    action: str
    status: int
    loop: str | None = Field(description="The loop that it was done to, where it was to one.")
    tuning_id: str | None


class Audit(Response):
    """Entries of the audit, the newest first."""

    entries: list[AuditEntry]


class Reloaded(Response):
    """Differences of another configuration: names of loops, and keys that take effect with the next start."""

    added: list[str]
    changed: list[str]
    removed: list[str]
    held: list[str] = Field(description="They differ, but tunings hold them: they stay as they are until then.")
    restart: list[str] = Field(description="Keys of [service] that need a restart.")


class ProblemType(Response):
    """A kind of problem."""

    type: str
    title: str
    status: int
