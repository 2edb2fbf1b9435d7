"""Errors of a call: the service's own problem, or none that it reported."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    import httpx

PROBLEM = "application/problem+json"


class ServiceError(AutotunerError):
    """The service refused, or failed.

    Attributes
    ----------
    status : int
        Status of the answer.
    type : str
        Kind of the problem, such as ``/v1/problems#loop-busy``; ``about:blank`` where the service reported none.
    problem : dict
        All members of the problem (RFC 9457).
    """

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        super().__init__(
            str(problem.get("detail") or problem.get("title") or f"the service answered {status}"),
            remedy=str(problem.get("remedy") or "Look into the log of the service."),
        )
        self.status = status
        self.type = str(problem.get("type", "about:blank"))
        self.problem = problem

    def __str__(self) -> str:
        return f"{self.message} ({self.status})"


class StreamError(AutotunerError):
    """The events of a tuning broke off again and again."""


def check(response: httpx.Response) -> None:
    """Raise `ServiceError` unless a request succeeded; the answer must have been read."""
    if response.is_success:
        return
    content: dict[str, Any] = {}
    if response.headers.get("content-type", "").startswith(PROBLEM):
        content = response.json()
    raise ServiceError(response.status_code, content)
