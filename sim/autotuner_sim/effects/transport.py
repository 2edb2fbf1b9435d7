"""Transport of the input to the plant: a fixed dead time, or a flow that determines the dead time.

    FixedDelay   u(t - D)
    PlugFlow     u(t - D(t)),  integral of q over D(t) = V,   q = 1 + share (u - u_rest)/span

When the flow rises, the content of a pipe of constant volume leaves it earlier (plug flow; Zenger and Niemi, Modelling
and control of a class of time-varying continuous flow processes, 2009). The present flow moves all the content of the
pipe together. Positions in output units, times in s.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol


class Transport(Protocol):
    """Transport between the actuator and the plant's input."""

    def rest(self, position: float) -> None:
        """Have carried `position` from the beginning of time."""

    def send(self, t: float, position: float) -> None:
        """Take a new position at `t`."""

    def next_arrival_s(self) -> float:
        """Return when the next position arrives if nothing else is sent, infinite if none is on its way."""

    def receive(self, t: float) -> float:
        """Return the position that arrives at `t`."""


@dataclass(slots=True)
class FixedDelay:
    """Every position arrives `delay_s` after it was sent."""

    delay_s: float
    _arrived: float = field(default=0.0, init=False)
    _on_its_way: deque[tuple[float, float]] = field(default_factory=deque, init=False)

    def rest(self, position: float) -> None:
        """Have carried `position` from the beginning of time."""
        self._arrived = position

    def send(self, t: float, position: float) -> None:
        """Take a new position at `t`."""
        self._on_its_way.append((t + self.delay_s, position))

    def next_arrival_s(self) -> float:
        """Return when the next position arrives."""
        return self._on_its_way[0][0] if self._on_its_way else math.inf

    def receive(self, t: float) -> float:
        """Return the position that arrives at `t`."""
        while self._on_its_way and self._on_its_way[0][0] <= t:
            self._arrived = self._on_its_way.popleft()[1]
        return self._arrived


@dataclass(slots=True)
class PlugFlow:
    """A pipe that takes `delay_s` at the rest point, and as much less as the flow is larger.

    `share` is the part of the flow that changes when the position moves by `span`; the flow stays above a tenth.
    """

    delay_s: float
    share: float
    span: float
    _origin: float = field(default=0.0, init=False)
    _arrived: float = field(default=0.0, init=False)
    _flow: float = field(default=1.0, init=False)
    _moved_s: float = field(default=-math.inf, init=False)
    _on_its_way: deque[tuple[float, float]] = field(default_factory=deque, init=False)
    _carried_s: float = field(default=0.0, init=False)

    def rest(self, position: float) -> None:
        """Have carried `position` from the beginning of time."""
        self._origin = self._arrived = position

    def send(self, t: float, position: float) -> None:
        """Take a new position at `t`, and flow accordingly from then on."""
        self._carry(t)
        self._flow = max(1.0 + self.share * (position - self._origin) / self.span, 0.1)
        self._on_its_way.append((self._carried_s + self.delay_s, position))

    def next_arrival_s(self) -> float:
        """Return when the next position arrives if the flow stays."""
        if not self._on_its_way:
            return math.inf
        return self._moved_s + max(self._on_its_way[0][0] - self._carried_s, 0.0) / self._flow

    def receive(self, t: float) -> float:
        """Return the position that arrives at `t`."""
        while self._on_its_way and self.next_arrival_s() <= t:
            self._carry(self.next_arrival_s())
            mark, self._arrived = self._on_its_way.popleft()
            self._carried_s = max(self._carried_s, mark)
        return self._arrived

    def _carry(self, t: float) -> None:
        if math.isfinite(self._moved_s):
            self._carried_s += self._flow * max(t - self._moved_s, 0.0)
        self._moved_s = max(t, self._moved_s)
