"""Who may talk to the service: what is checked before a request is looked into.

Rules of this file:

1. Whoever reaches the service can move an actuator. Beyond loopback it therefore listens only when there are tokens;
   once there is one, every request needs one, from this machine too. What is not listed as reading needs an operator's.
2. A page in the operator's browser reaches loopback too. Under a foreign name (DNS rebinding) it is turned away by the
   `Host` header; an action that it asks for in its own name, by `Origin` and `Sec-Fetch-Site`.
3. Every body is bounded by what has arrived, whatever its length was declared to be, and every client by what it asked.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
from functools import lru_cache
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from autotuner.errors import AutotunerError
from autotuner.service.errors import (
    BodyTooLargeError,
    ForeignHostError,
    ForeignOriginError,
    RoleError,
    TokenError,
    TooManyRequestsError,
)
from autotuner.service.problems import TYPES, problem_response
from autotuner.service.tokens import Role

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from autotuner.service.limits import Buckets
    from autotuner.service.tokens import Token, Tokens

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
OWN_SITES = frozenset({"same-origin", "none"})
"""Values of `Sec-Fetch-Site` of a page of ours and of a person's own action."""
OPEN = re.compile(rf"/|/page/.*|/healthz|{TYPES}")
"""Paths that need no token: the page, which is the same for everybody, and whether the process answers."""
COMPUTING = re.compile(r"/v1/(identifications|diagnoses|loops/.+/plan|tunings/[^/]+/gains)")
"""Paths whose POST moves nothing and changes nothing: a viewer may."""
LOCAL = "local"
"""Who acts where no token is needed."""
SECURE = (
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
"""Headers of every answer that does not say otherwise."""


class Gate:
    """ASGI middleware that turns requests away, as problems, and tells who asks: `scope["actor"]`.

    Parameters
    ----------
    app : ASGIApp
        What lies behind.
    hosts : frozenset of str
        Names under which the service is addressed, in lower case and without ports.
    any_address : bool
        Whether it is addressed by any IP address too: where it listens beyond loopback.
    tokens : Tokens
        Who may.
    buckets : Buckets
        How much.
    body_limit : int
        Largest body, bytes.
    body_limits : mapping of str to int
        The same for single paths.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        hosts: frozenset[str],
        any_address: bool,
        tokens: Tokens,
        buckets: Buckets,
        body_limit: int,
        body_limits: Mapping[str, int],
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._any_address = any_address
        self._tokens = tokens
        self._buckets = buckets
        self._body_limit = body_limit
        self._body_limits = body_limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check an HTTP request and pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit, told = self._body_limits.get(scope["path"], self._body_limit), secured(send)
        try:
            self._check(scope, limit)
        except AutotunerError as error:
            await problem_response(error, scope["path"])(scope, receive, told)
        else:
            await self._app(scope, bounded(receive, limit), told)

    def _check(self, scope: Scope, limit: int) -> None:
        headers = Headers(scope=scope)
        check_host(headers, self._hosts, any_address=self._any_address)
        if scope["method"] not in SAFE_METHODS:
            check_origin(headers, scope.get("scheme", "http"))
        client = scope.get("client") or ("", 0)
        wait_s = self._buckets.wait_s(client[0], asyncio.get_running_loop().time())
        if wait_s > 0.0:
            raise TooManyRequestsError(wait_s)
        scope["actor"] = LOCAL
        if self._tokens.required and not OPEN.fullmatch(scope["path"]):
            token = token_of(headers, self._tokens)
            check_role(token, scope["method"], scope["path"])
            scope["actor"] = token.name
        check_length(headers, limit)


def token_of(headers: Headers, tokens: Tokens) -> Token:
    """Return whose token a request carries; raise `TokenError` for none, an unknown and a revoked one."""
    kind, _, secret = headers.get("authorization", "").partition(" ")
    found = tokens.holder(secret.strip()) if kind.lower() == "bearer" else None
    if found is None:
        raise TokenError(
            "carries no valid token" if kind else "carries no token",
            field="Authorization",
            remedy="Send the header Authorization: Bearer TOKEN; an administrator makes one by autotuner token add.",
        )
    return found


def check_role(token: Token, method: str, path: str) -> None:
    """Raise `RoleError` when a viewer asks for more than reading."""
    if token.role is not Role.OPERATOR and method not in SAFE_METHODS and not COMPUTING.fullmatch(path):
        raise RoleError(
            f"is a {token.role.value}'s, which only reads",
            field="token",
            value=token.name,
            remedy="Ask an operator, or an administrator for an operator's token.",
        )


def secured(send: Send) -> Send:
    """Return `send` that adds the secure headers to an answer which does not say otherwise."""

    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            given = {name.lower() for name, _ in headers}
            message["headers"] = [*headers, *(header for header in SECURE if header[0] not in given)]
        await send(message)

    return with_headers


def check_host(headers: Headers, hosts: frozenset[str], *, any_address: bool = False) -> None:
    """Raise `ForeignHostError` unless the request is addressed to one of `hosts`, on any port.

    An IP address is no name that somebody else could turn to this machine: `any_address` lets it pass.
    """
    given = headers.get("host", "")
    name = _name_in(given)
    if name not in hosts and not (any_address and _is_address(name)):
        raise ForeignHostError(
            "is not a name of this service",
            field="Host",
            value=given,
            remedy=f"Address it as {', '.join(sorted(hosts))}.",
        )


@lru_cache(maxsize=64)
def _name_in(given: str) -> str | None:
    try:
        return urlsplit(f"//{given}").hostname
    except ValueError:
        return None


def _is_address(name: str | None) -> bool:
    try:
        ipaddress.ip_address(name or "")
    except ValueError:
        return False
    return True


def check_origin(headers: Headers, scheme: str = "http") -> None:
    """Raise `ForeignOriginError` for an action that a page of another origin asks for.

    A browser says so by `Origin`, and newer ones by `Sec-Fetch-Site`; a program that is no browser sends neither.
    """
    own = f"{scheme}://{headers.get('host', '')}".lower()
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
