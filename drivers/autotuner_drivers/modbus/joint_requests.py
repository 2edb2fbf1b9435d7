"""Combined requests of several loops of one device: reads of nearby registers of one table become one read.

    a, b one request:    same unit and table,   start(b) - end(a) <= max_gap,   end(b) - start(a) <= longest read

A device may refuse the registers between two loops, ignore a long read, or close the connection. A joint read is
therefore on trial until the device has answered a read that covers it. The parts of a failed trial are requested one by
one. If the device answers them, they stay apart from then on.

Invariants: pure; no joint read counts as answered before the device has answered it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from autotuner_drivers.modbus.protocol import READ_CODES, Request
from autotuner_drivers.modbus.registers import BIT_TABLES

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from autotuner_drivers.modbus.register_map import DeviceLimits

BIT_READS = frozenset(READ_CODES[table] for table in READ_CODES if table in BIT_TABLES)
READS = frozenset(READ_CODES.values())


class Joint(NamedTuple):
    """A request, and the indices of those that it serves, by address.

    Attributes
    ----------
    request : Request
        What is sent.
    parts : tuple of int
        Indices of the requests whose answers it holds; of one alone where it is that request itself.
    """

    request: Request
    parts: tuple[int, ...]


@dataclass(slots=True)
class _Span:
    """Requests that become one, so far."""

    parts: list[int]
    first: Request
    end: int

    def joint(self) -> Joint:
        first = self.first
        return Joint(first._replace(count=self.end - first.address), tuple(self.parts))


class JointRequests:
    """Which reads of one device are one request.

    Parameters
    ----------
    limits : DeviceLimits
        The longest read, and the widest gap.
    """

    def __init__(self, limits: DeviceLimits) -> None:
        self._limits = limits
        self._apart: set[tuple[Request, Request]] = set()
        self._answered: list[Request] = []

    def joined(self, requests: Sequence[Request]) -> list[Joint]:
        """Return the requests to be sent, by table and address: joined reads, and separate writes."""
        joints: list[Joint] = []
        span: _Span | None = None
        last: Request | None = None
        for index in sorted(range(len(requests)), key=lambda index: _place(requests[index])):
            request = requests[index]
            if span is not None and last is not None and self._fits(span, last, request):
                span.parts.append(index)
                span.end = max(span.end, _end(request))
            else:
                joints += [] if span is None else [span.joint()]
                span = _Span([index], request, _end(request))
            last = request
        return joints if span is None else [*joints, span.joint()]

    def _fits(self, span: _Span, last: Request, request: Request) -> bool:
        first, limits = span.first, self._limits
        longest = limits.max_bits_per_read if request.function in BIT_READS else limits.max_registers_per_read
        return (
            request.function in READS
            and (request.function, request.unit) == (first.function, first.unit)
            and request.address - span.end <= limits.max_gap
            and max(span.end, _end(request)) - first.address <= longest
            and (request == last or (last, request) not in self._apart)
        )

    def on_trial(self, joint: Joint) -> bool:
        """Return whether the device has not yet answered a read that covers this joint read."""
        return len(joint.parts) > 1 and not any(_covers(one, joint.request) for one in self._answered)

    def doubted(self, joint: Joint) -> None:
        """Record that the device did not answer a joint read, which is on trial again."""
        self._answered = [one for one in self._answered if not _covers(one, joint.request)]

    def answered(self, joint: Joint) -> None:
        """Record that the device answers a joint read, and thus any part of it."""
        self._answered = [one for one in self._answered if not _covers(joint.request, one)]
        self._answered.append(joint.request)

    def keep_apart(self, parts: Sequence[Request], refused: Collection[Request]) -> None:
        """Record that the device answers parts separately, but not as one read.

        Parameters
        ----------
        parts : sequence of Request
            The parts in order of address.
        refused : collection of Request
            The parts that it refuses separately, too. If there are any, only their neighbours stay apart from them.
        """
        self._apart |= {
            (one, other) for one, other in pairwise(parts) if not refused or one in refused or other in refused
        }


def _place(request: Request) -> tuple[int, int, int, int]:
    return -1 if request.unit is None else request.unit, request.function, request.address, request.count


def _end(request: Request) -> int:
    return request.address + request.count


def _covers(one: Request, other: Request) -> bool:
    same = (one.function, one.unit) == (other.function, other.unit)
    return same and one.address <= other.address and _end(other) <= _end(one)
