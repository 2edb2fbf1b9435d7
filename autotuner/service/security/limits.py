"""Rate limits of one client and of all clients together.

    level = min(burst, level + rate dt) - 1             requests of a client, by a token bucket

Invariants:

1. Memory is bounded, however many addresses send requests.
2. A client is the token of a request, or the address of one without a valid token; of IPv6 its network of 64 bits,
   the size of one subscriber's network.
"""

from __future__ import annotations

import contextlib
import ipaddress
from collections import Counter, OrderedDict
from functools import lru_cache
from typing import TYPE_CHECKING

from autotuner.service.errors import OverloadedError, TooManyRequestsError

if TYPE_CHECKING:
    from collections.abc import Iterator

REMEMBERED = 4096
"""Clients remembered; the one that was quiet longest goes first, with a full bucket."""
SUBSCRIBER_BITS = 64
"""Length of the IPv6 network of one subscriber (RFC 6177)."""
LONGEST_NAME = 64
"""Length of a client's name without an address, characters."""
BUSY_S = 1.0
"""Time after which a client at its limit of concurrent requests may retry, s."""


@lru_cache(maxsize=1024)
def client_of(address: str) -> str:
    """Return under which name the requests of an address are counted."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address[:LONGEST_NAME] or "unknown"
    if isinstance(ip, ipaddress.IPv4Address):
        return str(ip)
    mapped = ip.ipv4_mapped
    return str(mapped or ipaddress.ip_network((ip, SUBSCRIBER_BITS), strict=False))


class Buckets:
    """The buckets of all clients.

    Parameters
    ----------
    rate_per_s : float
        Requests that each client gains per second.
    burst : float
        Most requests at once.
    """

    def __init__(self, rate_per_s: float, burst: float) -> None:
        self._rate, self._burst = rate_per_s, burst
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str, now_s: float) -> float:
        """Take one request out of a client's bucket; return 0, or the time until there is one, s."""
        level, then_s = self._levels.pop(client, (self._burst, now_s))
        level = min(self._burst, level + self._rate * (now_s - then_s))
        left = level - 1.0 if level >= 1.0 else level
        self._levels[client] = (left, now_s)
        if len(self._levels) > REMEMBERED:
            self._levels.popitem(last=False)
        return 0.0 if level >= 1.0 else (1.0 - level) / self._rate

    def take(self, client: str, now_s: float) -> None:
        """Take one token from a client's bucket; raise `TooManyRequestsError` when it is empty."""
        wait_s = self.wait_s(client, now_s)
        if wait_s > 0.0:
            raise TooManyRequestsError(wait_s)


class Places:
    """Limit of concurrent requests, of each client and in total.

    Parameters
    ----------
    most : int
        In all.
    most_of_a_client : int
        Of one client.
    """

    def __init__(self, most: int, most_of_a_client: int) -> None:
        self._most, self._most_of_a_client = most, most_of_a_client
        self._taken = Counter[str]()

    @contextlib.contextmanager
    def place(self, client: str) -> Iterator[None]:
        """Hold one place of a client.

        Raises
        ------
        TooManyRequestsError
            The client holds as many as it may.
        OverloadedError
            All are taken.
        """
        if self._taken[client] >= self._most_of_a_client:
            raise TooManyRequestsError(BUSY_S)
        if self._taken.total() >= self._most:
            raise OverloadedError(BUSY_S)
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]


class Thinning:
    """Which of many alike events are recorded, so that no client fills a disk: some at once, then one now and then.

    Parameters
    ----------
    of_a_client, in_all : Buckets
        How many events are recorded.
    """

    ALL = "all clients"

    def __init__(self, of_a_client: Buckets, in_all: Buckets) -> None:
        self._of_a_client, self._in_all = of_a_client, in_all
        self._left_out: OrderedDict[str, int] = OrderedDict()

    def recorded(self, client: str, now_s: float) -> int | None:
        """Return None for an event that is skipped, else the number of the client's events skipped before it."""
        if self._of_a_client.wait_s(client, now_s) == 0.0 and self._in_all.wait_s(self.ALL, now_s) == 0.0:
            return self._left_out.pop(client, 0)
        self._left_out[client] = self._left_out.pop(client, 0) + 1
        if len(self._left_out) > REMEMBERED:
            self._left_out.popitem(last=False)
        return None
