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


class TokenError(RequestError):
    """The request has no token, or one that is worth nothing."""


class RoleError(RequestError):
    """The token does not allow the request."""


class TooManyRequestsError(RequestError):
    """The client asks more often than is good for the loops; after `wait_s` it may ask again."""

    def __init__(self, wait_s: float) -> None:
        super().__init__("asks too often", field="client", remedy=f"Wait {wait_s:.2g} s, and follow events instead.")
        self.wait_s = wait_s


class OverloadedError(RequestError):
    """The service has as much under way as it can; `wait_s` is when to try again."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(
            "has too many requests under way", field="service", remedy=f"Try again in {wait_s:.2g} s, or close others."
        )
        self.wait_s = wait_s


class SlowBodyError(RequestError):
    """The body of a request did not arrive in time."""


class FramingError(RequestError):
    """The length of a body is given in two ways."""


class MediaTypeError(RequestError):
    """The body is of a kind that this path does not take."""


class ListenError(AutotunerError):
    """The service cannot listen on its address."""
