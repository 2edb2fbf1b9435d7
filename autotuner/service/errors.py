"""Errors of the service itself: about requests, not about loops."""

from __future__ import annotations

from autotuner.errors import AutotunerError


class RequestError(AutotunerError):
    """A request that is turned away before it is looked into."""


class ForeignHostError(RequestError):
    """The request names a host that this service is not."""


class ForeignOriginError(RequestError):
    """A page of another origin asks for an action."""


class BodyTooLargeError(RequestError):
    """The body is larger than this path takes."""


class MediaTypeError(RequestError):
    """The body is of a kind that this path does not take."""


class ListenError(AutotunerError):
    """The service cannot listen on its address."""
