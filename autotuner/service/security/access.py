"""Access control: checks before a request reaches the application.

Invariants:

1. A client that reaches the service can move an actuator. Beyond loopback the service therefore requires
   tokens; once there is a token, every request needs one, from this machine too. A request that is not listed as
   reading needs an operator's token.
2. A page in the operator's browser reaches loopback too. The `Host` header refuses a page under a foreign name (DNS
   rebinding); `Origin` and `Sec-Fetch-Site` refuse an action of a page of another origin.
3. Every body is bounded by the received bytes, whatever its declared length, and by its duration.
4. Clients are distinguished by their valid token, else by their address. Other clients of the same address do not slow
   a valid token down, with one exception: the limit of their concurrent requests.
5. Requests that end a movement, and health checks, have their own quotas: no other request of any client, not even an
   abort of another tuning, can exhaust them.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from autotuner.errors import AutotunerError
from autotuner.service.errors import (
    BodyTooLargeError,
    ForeignHostError,
    ForeignOriginError,
    FramingError,
    RoleError,
    SlowBodyError,
    TokenError,
)
from autotuner.service.problems import TYPES, problem_response
from autotuner.service.security.limits import Buckets, Places, client_of
from autotuner.service.security.tokens import Role

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from autotuner.configuration import ServiceTable
    from autotuner.service.security.tokens import Token, Tokens

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
OWN_SITES = frozenset({"same-origin", "none"})
"""Values of `Sec-Fetch-Site` of a page of ours and of a person's own action."""
OPEN = re.compile(rf"/|/page/.*|/healthz|{TYPES}")
"""Paths that need no token: the page, which is the same for everybody, and whether the process answers."""
COMPUTING = re.compile(r"/v1/(identifications|diagnoses|loops/.+/plan|tunings/[^/]+/gains)")
"""Paths whose POST moves and changes nothing, which a viewer may use."""
LOCAL = "local"
"""Actor where no token is needed."""
RESERVED = re.compile(r"(GET|HEAD) (/healthz|/readyz)|POST /v1/(tunings|schedules)/[^/]+/abort")
"""Requests that are served whatever else is requested."""
BODY_LIMIT = 64 * 1024
"""Largest body of a request that uploads no recording, bytes."""
BODY_GRACE_S = 10.0
"""Time in which the first byte of a body must arrive, s."""
BODY_RATE = 16 * 1024
"""Slowest rate at which a body may arrive after that, bytes/s."""
BURST_S = 10.0
"""Requests that a client may send at once, in seconds of its rate."""
REFUSED_SHARE = 0.1
"""Refused requests of a client that are answered as such, as a share of all that it may send; beyond it: 429."""
RESERVED_SHARE = 0.1
"""Requests of each `RESERVED` kind and path, in addition, as a share of the others."""
CLIENT_SHARE = 0.5
"""Concurrent requests of one client, as a share of those of all."""
SECURE = (
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
"""Default headers of every answer."""


@dataclass(frozen=True, slots=True)
class Quotas:
    """Limits of requests.

    Attributes
    ----------
    requests : Buckets
        Requests of each client.
    refusals : Buckets
        Requests of each address, or token, that are refused: failed logins, for example.
    reserved : Buckets
        Requests of each client to each `RESERVED` path, which nothing else uses up.
    under_way : Places
        Requests at once, without the `RESERVED` ones.
    body_bytes : int
        Largest body, bytes.
    body_bytes_of : mapping of str to int
        The same for single paths.
    """

    requests: Buckets
    refusals: Buckets
    reserved: Buckets
    under_way: Places
    body_bytes: int
    body_bytes_of: Mapping[str, int]

    @classmethod
    def of(cls, service: ServiceTable, body_bytes_of: Mapping[str, int]) -> Quotas:
        """Return the quotas of a configuration."""
        rate, most = service.requests_per_s, service.connections_limit

        def buckets(share: float) -> Buckets:
            return Buckets(share * rate, share * rate * BURST_S)

        under_way = Places(most, max(1, round(CLIENT_SHARE * most)))
        return cls(buckets(1.0), buckets(REFUSED_SHARE), buckets(RESERVED_SHARE), under_way, BODY_LIMIT, body_bytes_of)


class Gate:
    """ASGI middleware that refuses requests, as problems, and names the caller in `scope`: `actor` and `client_key`.

    Parameters
    ----------
    app : ASGIApp
        The application.
    hosts : frozenset of str
        Names under which the service is addressed, in lower case and without ports.
    any_address : bool
        Whether it is addressed by any IP address too: where it listens beyond loopback.
    tokens : Tokens
        The tokens, and the permissions of each.
    quotas : Quotas
        Limits of requests.
    """

    def __init__(
        self, app: ASGIApp, *, hosts: frozenset[str], any_address: bool, tokens: Tokens, quotas: Quotas
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._any_address = any_address
        self._tokens = tokens
        self._quotas = quotas

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check an HTTP request and pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._quotas.body_bytes_of.get(scope["path"], self._quotas.body_bytes)
        send = secured(send)
        with ExitStack() as held:
            try:
                self._check(scope, limit)
                if not is_reserved(scope):
                    held.enter_context(self._quotas.under_way.place(scope["client_key"]))
            except AutotunerError as error:
                await problem_response(error, scope["path"])(scope, receive, send)
            else:
                await self._app(scope, bounded(receive, limit), send)

    def _check(self, scope: Scope, limit: int) -> None:
        headers, now_s = Headers(scope=scope), asyncio.get_running_loop().time()
        address = client_of((scope.get("client") or ("", 0))[0])
        scope["client_key"], scope["actor"] = address, f"address {address}"
        try:
            self._identify(scope, headers)
            check_length(headers, limit)
        except AutotunerError:
            self._quotas.refusals.take(scope["client_key"], now_s)
            raise
        if is_reserved(scope):
            self._quotas.reserved.take(f"{scope['client_key']} {scope['path']}", now_s)
        else:
            self._quotas.requests.take(scope["client_key"], now_s)

    def _identify(self, scope: Scope, headers: Headers) -> None:
        """Refuse a request that may not be made, and name the caller of one that may."""
        check_host(headers, self._hosts, any_address=self._any_address)
        if scope["method"] not in SAFE_METHODS:
            check_origin(headers, scope.get("scheme", "http"))
        if OPEN.fullmatch(scope["path"]):
            return
        if not self._tokens.required:
            scope["actor"] = LOCAL
            return
        token = token_of(headers, self._tokens)
        scope["client_key"], scope["actor"] = f"token {token.name}", token.name
        check_role(token, scope["method"], scope["path"])


def is_reserved(scope: Scope) -> bool:
    """Return whether a request ends a movement, or is a health check."""
    return RESERVED.fullmatch(f"{scope['method']} {scope['path']}") is not None


def token_of(headers: Headers, tokens: Tokens) -> Token:
    """Return the holder of a request's token; raise `TokenError` for a missing, unknown or revoked one."""
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
    """Raise `RoleError` when a viewer requests more than reading."""
    if token.role is not Role.OPERATOR and method not in SAFE_METHODS and not COMPUTING.fullmatch(path):
        raise RoleError(
            f"is a {token.role.value}'s, which only reads",
            field="token",
            value=token.name,
            remedy="Ask an operator, or an administrator for an operator's token.",
        )


def secured(send: Send) -> Send:
    """Return `send` with the secure headers as defaults."""

    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            given = {name.lower() for name, _ in headers}
            message["headers"] = [*headers, *(header for header in SECURE if header[0] not in given)]
        await send(message)

    return with_headers


def check_host(headers: Headers, hosts: frozenset[str], *, any_address: bool = False) -> None:
    """Raise `ForeignHostError` unless the request is addressed to one of `hosts`, on any port.

    An IP address cannot be rebound to this machine by others: `any_address` accepts it.
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
    """Raise `ForeignOriginError` for an action that a page of another origin requests.

    A browser sends `Origin`, and newer ones `Sec-Fetch-Site`; other programs send neither.
    """
    own = f"{scheme}://{headers.get('host', '')}".lower()
    origin, site = headers.get("origin"), headers.get("sec-fetch-site")
    foreign = (origin is not None and origin.lower() != own) or (site is not None and site not in OWN_SITES)
    if foreign:
        raise ForeignOriginError(
            "is not the origin of this service",
            field="Origin",
            value=origin,
            remedy=f"Use a page of {own} or a program that is not a browser.",
        )


def check_length(headers: Headers, limit: int) -> None:
    """Raise `BodyTooLargeError` for a body that is declared to be too large, `FramingError` for two kinds of length.

    A proxy that believes the other of the two sees other requests than this service does (RFC 9112, section 6.1).
    """
    if "content-length" in headers and "transfer-encoding" in headers:
        raise FramingError(
            "has both Content-Length and Transfer-Encoding", field="headers", remedy="Send one of the two."
        )
    declared = headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > limit:
        raise _too_large(limit)


def bounded(receive: Receive, limit: int) -> Receive:
    """Return `receive` for a body of at most `limit` bytes, which arrives at `BODY_RATE` or faster.

    It raises `BodyTooLargeError` or `SlowBodyError`.
    """
    arrived, complete = 0, False
    deadline_s: float | None = None

    async def counted() -> Message:
        nonlocal arrived, complete, deadline_s
        if complete:  # what follows is the end of the connection, for which there is no time limit
            return await receive()
        deadline_s = deadline_s or asyncio.get_running_loop().time() + BODY_GRACE_S
        try:
            async with asyncio.timeout_at(deadline_s + arrived / BODY_RATE):
                message = await receive()
        except TimeoutError as error:
            raise SlowBodyError(
                f"arrived at less than {BODY_RATE // 1024} KiB/s", field="body", remedy="Send it without pauses."
            ) from error
        arrived += len(message.get("body", b""))
        complete = not message.get("more_body", False)
        if arrived > limit:
            raise _too_large(limit)
        return message

    return counted


def _too_large(limit: int) -> BodyTooLargeError:
    return BodyTooLargeError(
        f"is larger than {limit} bytes", field="body", remedy="Send a smaller one; thin out a long recording."
    )
