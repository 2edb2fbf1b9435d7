"""Errors of the service itself: about requests, not about loops."""

from __future__ import annotations

from autotuner.errors import AutotunerError


class RequestError(AutotunerError):
    """A request that is refused before it is processed."""


class ForeignHostError(RequestError):
    """The request names a host that this service is not."""


class ForeignOriginError(RequestError):
    """A page of another origin requests an action."""


class BodyTooLargeError(RequestError):
    """The body is larger than this path takes."""


class TokenError(RequestError):
    """The request has no token, or an invalid one."""


class RoleError(RequestError):
    """The token does not allow the request."""


class TooManyRequestsError(RequestError):
    """The client sends more requests than the loops allow; it may retry after `wait_s`."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(
            "sends too many requests", field="client", remedy=f"Wait {wait_s:.2g} s, and follow events instead."
        )
        self.wait_s = wait_s


class OverloadedError(RequestError):
    """The service has reached its limit of concurrent requests; retry after `wait_s`."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(
            "has too many concurrent requests", field="service", remedy=f"Try again in {wait_s:.2g} s, or close others."
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
