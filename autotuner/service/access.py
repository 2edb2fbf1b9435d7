"""Who may talk to the service: what is checked before a request is looked into.

Rules of this file:

1. Whoever reaches the service can move an actuator, so it listens on loopback only.
2. A page in the operator's browser reaches loopback too. Under a foreign name (DNS rebinding) it is turned away by the
   `Host` header; an action that it asks for in its own name, by `Origin` and `Sec-Fetch-Site`.
3. Every body is bounded by what has arrived, whatever its length was declared to be.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from autotuner.errors import ConfigurationError
from autotuner.service.errors import BodyTooLargeError, ForeignHostError, ForeignOriginError, RequestError
from autotuner.service.problems import problem_response

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
OWN_SITES = frozenset({"same-origin", "none"})
"""Values of `Sec-Fetch-Site` of a page of ours and of a person's own action."""


def require_loopback(host: str) -> None:
    """Refuse an address that other machines reach.

    Raises
    ------
    ConfigurationError
        Names ``service.host``.
    """
    if host == "localhost":
        return
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise ConfigurationError(
            "is not a loopback address, and whoever reaches the service can move an actuator",
            field="service.host",
            value=host,
            remedy="Use 127.0.0.1, ::1 or localhost, and reach it from elsewhere through an SSH tunnel.",
        )


class Gate:
    """ASGI middleware that turns requests away, as problems.

    Parameters
    ----------
    app : ASGIApp
        What lies behind.
    hosts : frozenset of str
        Names under which the service is addressed, in lower case and without ports.
    body_limit : int
        Largest body, bytes.
    body_limits : mapping of str to int
        The same for single paths.
    """

    def __init__(self, app: ASGIApp, *, hosts: frozenset[str], body_limit: int, body_limits: Mapping[str, int]) -> None:
        self._app = app
        self._hosts = hosts
        self._body_limit = body_limit
        self._body_limits = body_limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check an HTTP request and pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers, limit = Headers(scope=scope), self._body_limits.get(scope["path"], self._body_limit)
        try:
            check_host(headers, self._hosts)
            if scope["method"] not in SAFE_METHODS:
                check_origin(headers)
            check_length(headers, limit)
        except RequestError as error:
            await problem_response(error, scope["path"])(scope, receive, send)
        else:
            await self._app(scope, bounded(receive, limit), send)


def check_host(headers: Headers, hosts: frozenset[str]) -> None:
    """Raise `ForeignHostError` unless the request is addressed to one of `hosts`, on any port."""
    given = headers.get("host", "")
    try:
        name = urlsplit(f"//{given}").hostname
    except ValueError:
        name = None
    if name not in hosts:
        raise ForeignHostError(
            "is not a name of this service",
            field="Host",
            value=given,
            remedy=f"Address it as {', '.join(sorted(hosts))}.",
        )


def check_origin(headers: Headers) -> None:
    """Raise `ForeignOriginError` for an action that a page of another origin asks for.

    A browser says so by `Origin`, and newer ones by `Sec-Fetch-Site`; a program that is no browser sends neither.
    """
    own = f"http://{headers.get('host', '')}".lower()
    origin, site = headers.get("origin"), headers.get("sec-fetch-site")
    foreign = (origin is not None and origin.lower() != own) or (site is not None and site not in OWN_SITES)
    if foreign:
        raise ForeignOriginError(
            "is not the origin of this service",
            field="Origin",
            value=origin,
            remedy=f"Use a page of {own} or a program that is no browser.",
        )


def check_length(headers: Headers, limit: int) -> None:
    """Raise `BodyTooLargeError` for a body that is declared to be too large."""
    declared = headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > limit:
        raise _too_large(limit)


def bounded(receive: Receive, limit: int) -> Receive:
    """Return `receive` that raises `BodyTooLargeError` once more than `limit` bytes have arrived."""
    arrived = 0

    async def counted() -> Message:
        nonlocal arrived
        message = await receive()
        arrived += len(message.get("body", b""))
        if arrived > limit:
            raise _too_large(limit)
        return message

    return counted


def _too_large(limit: int) -> BodyTooLargeError:
    return BodyTooLargeError(
        f"is larger than {limit} bytes", field="body", remedy="Send a smaller one; thin out a long recording."
    )
