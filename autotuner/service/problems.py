"""Errors on the wire: one table, as problem details (RFC 9457).

Invariants:

1. The class of an error decides, by the row of its nearest base class in `PROBLEMS`; no built-in exception has a row.
2. A problem names the refused item (`field`, `value`) and the next step (`remedy`).
3. An unexpected exception is a 500 that reveals nothing of the inside; it is raised on, so that the server logs it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from autotuner.errors import (
    AutotunerError,
    ComputationError,
    DriverError,
    GainsChangedError,
    InputError,
    LoopBusyError,
    RecordingError,
    ShuttingDownError,
    StorageError,
    TuningStateError,
    UnknownLoopError,
    UnknownScheduleError,
    UnknownTuningError,
)
from autotuner.service.errors import (
    BodyTooLargeError,
    ForeignHostError,
    ForeignOriginError,
    FramingError,
    MediaTypeError,
    OverloadedError,
    RoleError,
    SlowBodyError,
    TokenError,
    TooManyRequestsError,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fastapi import FastAPI
    from starlette.requests import Request

MEDIA_TYPE = "application/problem+json"
TYPES = "/v1/problems"
"""Path of the list of types; a type is this path and the row's name as the fragment."""


@dataclass(frozen=True, slots=True)
class Row:
    """Representation of a class of errors: status, last part of the type, title."""

    status: int
    name: str
    title: str

    @property
    def type(self) -> str:
        """The problem's type, a URI reference."""
        return f"{TYPES}#{self.name}"


PROBLEMS: dict[type[AutotunerError], Row] = {
    FramingError: Row(400, "ambiguous-length", "The length of the body is given in two ways"),
    TokenError: Row(401, "no-token", "A valid token is needed"),
    RoleError: Row(403, "wrong-role", "The token does not allow this"),
    ForeignOriginError: Row(403, "foreign-origin", "A page of another origin may not do this"),
    UnknownLoopError: Row(404, "unknown-loop", "No such loop"),
    UnknownScheduleError: Row(404, "unknown-schedule", "No such run over operating points"),
    UnknownTuningError: Row(404, "unknown-tuning", "No such tuning"),
    SlowBodyError: Row(408, "slow-body", "The body did not arrive in time"),
    LoopBusyError: Row(409, "loop-busy", "Another tuning holds the loop"),
    GainsChangedError: Row(409, "gains-changed", "The device holds other gains than expected"),
    TuningStateError: Row(409, "wrong-state", "The tuning is not in a state for this"),
    BodyTooLargeError: Row(413, "body-too-large", "The body is too large"),
    MediaTypeError: Row(415, "wrong-media-type", "The body is of the wrong kind"),
    ForeignHostError: Row(421, "foreign-host", "The request is for another host"),
    RecordingError: Row(422, "unusable-recording", "The recording cannot be used"),
    InputError: Row(422, "unusable-value", "A value cannot be used"),
    TooManyRequestsError: Row(429, "too-many-requests", "The client sends too many requests"),
    DriverError: Row(502, "device-error", "A device did not carry out a request"),
    OverloadedError: Row(503, "overloaded", "The service has too many concurrent requests"),
    ComputationError: Row(503, "computation-failed", "A computation could not be finished"),
    ShuttingDownError: Row(503, "shutting-down", "The service is stopping"),
    StorageError: Row(507, "storage-error", "The data directory cannot be used"),
}
UNEXPECTED = Row(500, "internal-error", "The service failed")

CLOSING = (FramingError, SlowBodyError, OverloadedError, TooManyRequestsError)
"""Errors after which the connection is closed: more of the request may follow, or the service needs the place."""

SENTENCES: dict[str, str] = {
    "missing": "is missing",
    "extra_forbidden": "is not a known name",
    "json_invalid": "is not JSON",
}
REMEDIES: dict[str, str] = {
    "missing": "Add it.",
    "extra_forbidden": "Remove it, or check its spelling.",
    "greater_than": "Give more than {gt}.",
    "greater_than_equal": "Give {ge} or more.",
    "less_than": "Give less than {lt}.",
    "less_than_equal": "Give {le} or less.",
    "finite_number": "Give a finite number.",
    "float_type": "Give a number.",
    "float_parsing": "Give a number.",
    "int_type": "Give a whole number.",
    "int_parsing": "Give a whole number.",
    "bool_type": "Give true or false.",
    "literal_error": "Use one of {expected}.",
    "json_invalid": "Send a JSON object.",
    "model_attributes_type": "Send a JSON object with the header Content-Type: application/json.",
}
"""Problem and remedy of a value that failed validation, by pydantic's name of the failure."""
LOOK_IT_UP = "See /openapi.json for what is accepted."


def row_of(error: AutotunerError) -> Row:
    """Return the row of the nearest base class; a class without one is an unexpected error."""
    return next((PROBLEMS[kind] for kind in type(error).__mro__ if kind in PROBLEMS), UNEXPECTED)


def problem_response(error: AutotunerError, path: str, more: Mapping[str, object] | None = None) -> Response:
    """Return an error as a problem; `path` is that of the request, `more` are further members."""
    members = {"detail": str(error), "instance": path, **error.to_dict(), **(more or {})}
    if isinstance(error, LoopBusyError):
        members["tuning_id"] = error.tuning_id
    del members["error"], members["message"]
    response = _response(row_of(error), members)
    if isinstance(error, TokenError):
        response.headers["WWW-Authenticate"] = "Bearer"
    if isinstance(error, TooManyRequestsError | OverloadedError):
        response.headers["Retry-After"] = str(math.ceil(error.wait_s))
    if isinstance(error, CLOSING):
        response.headers["Connection"] = "close"
    return response


def _response(row: Row, members: Mapping[str, object]) -> Response:
    members_given = {name: value for name, value in members.items() if value is not None}
    content = {"type": row.type, "title": row.title, "status": row.status, **members_given}
    text = json.dumps(content, allow_nan=False)  # in ASCII: a value of the request may contain lone surrogates
    return Response(text, row.status, media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Make every error of `app` a problem."""
    app.add_exception_handler(AutotunerError, _answer)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _of_the_framework)
    app.add_exception_handler(Exception, _unexpected)


async def _answer(request: Request, error: Exception) -> Response:
    assert isinstance(error, AutotunerError)  # noqa: S101 - what the handler was installed for
    return problem_response(error, request.url.path)


async def _invalid(request: Request, error: Exception) -> Response:
    """Report the first value that failed validation, and list all of them."""
    assert isinstance(error, RequestValidationError)  # noqa: S101 - what the handler was installed for
    refused = [_refusal(part) for part in error.errors()]
    listed = [{name: part for name, part in one.to_dict().items() if name != "error"} for one in refused]
    return problem_response(refused[0], request.url.path, {"errors": listed})


def _refusal(part: Mapping[str, Any]) -> InputError:
    """Return one failure of validation as an error of ours."""
    place, *names = part["loc"]
    kind, has_value = part["type"], part["type"] not in {"missing", "json_invalid"}
    return InputError(
        SENTENCES.get(kind, part["msg"].removeprefix("Input ")),
        field=".".join(map(str, names)) if names and kind != "json_invalid" else place,
        value=part["input"] if has_value else None,
        remedy=REMEDIES.get(kind, LOOK_IT_UP).format_map(part.get("ctx", {})),
    )


async def _of_the_framework(request: Request, error: Exception) -> Response:
    """Report refusals of the framework itself: unknown paths and methods, unreadable bodies."""
    assert isinstance(error, HTTPException)  # noqa: S101 - what the handler was installed for
    if isinstance(error.__cause__, AutotunerError):  # the framework wraps what stops it reading a body
        return problem_response(error.__cause__, request.url.path)
    status = HTTPStatus(error.status_code)
    if status is HTTPStatus.NO_CONTENT:
        return Response(status_code=status)
    members = {"type": "about:blank", "title": status.phrase, "status": status, "detail": error.detail}
    content = {**members, "instance": request.url.path, "remedy": LOOK_IT_UP}
    return Response(json.dumps(content), error.status_code, headers=error.headers, media_type=MEDIA_TYPE)


async def _unexpected(request: Request, _: Exception) -> Response:
    remedy = "Look into the log of the service, and please report this with it."
    return _response(UNEXPECTED, {"detail": UNEXPECTED.title, "instance": request.url.path, "remedy": remedy})


_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
ANY_PROBLEM: dict[int | str, dict[str, Any]] = {"default": {"description": "A problem", "content": _CONTENT}}
"""The API document's entries of errors that every path may return."""


def accepted(of_what: str) -> dict[int | str, dict[str, Any]]:
    """Return the API document's entry of a start: where it can be followed."""
    location = {"description": f"Path of the {of_what}.", "schema": {"type": "string"}}
    return {202: {"headers": {"Location": location}}}


def documented(*kinds: type[AutotunerError]) -> dict[int | str, dict[str, Any]]:
    """Return the API document's entries of these errors."""
    rows = [PROBLEMS[kind] for kind in kinds]
    return {
        status: {"description": "; ".join(row.title for row in rows if row.status == status), "content": _CONTENT}
        for status in sorted({row.status for row in rows})
    }
