"""Outcome of a request, and the account that a loop has of its requests."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.errors import DriverError
    from autotuner_drivers.modbus.protocol import Request


@dataclass(slots=True, eq=False)
class Exchange:
    """A request and its outcome: `words` of the answer, or an `error`.

    Attributes
    ----------
    request : Request
        The request.
    retries : int
        Largest number of repetitions.
    words : tuple of int
        The words, or the bits, of the answer.
    error : DriverError or None
        Why there is no answer.
    moment_s : float
        Time of execution by the device, on the clock of the event loop, s.
    repeated : int
        Number of repetitions.
    """

    request: Request
    retries: int
    words: tuple[int, ...] = ()
    error: DriverError | None = None
    moment_s: float = math.nan
    repeated: int = 0


@dataclass(slots=True, eq=False)
class Account:
    """Account of the requests of one loop.

    Attributes
    ----------
    moment_s : float
        Time of the last exchange that read the PV or wrote, on the clock of the event loop, s.
    repeated : int
        Number of repeated requests.
    """

    moment_s: float = math.nan
    repeated: int = 0

    def take(self, exchange: Exchange, *, last: bool = True) -> None:
        """Record an exchange; the `last` exchange of a call sets the moment."""
        self.repeated += exchange.repeated
        if last and exchange.error is None:
            self.moment_s = exchange.moment_s

    def words_of(self, exchange: Exchange) -> tuple[int, ...]:
        """Record an exchange, and return its words or raise its error."""
        self.take(exchange)
        if exchange.error is not None:
            raise exchange.error
        return exchange.words
