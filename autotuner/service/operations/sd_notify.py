"""Notifications to a service manager such as systemd: ready, alive, stopping, more time needed.

    NOTIFY_SOCKET     its socket: a path, or @ and a name of Linux's abstract namespace
    WATCHDOG_USEC     the longest time between two signs of life, us; WATCHDOG_PID names the process

Each message is a datagram. Source: the manual pages sd_notify(3) and sd_watchdog_enabled(3).

Invariants:

1. The event loop sends the heartbeat. A service whose event loop hangs is silent, and the service
   manager ends it.
2. A start or a stop that releases loops takes as long as the devices need: both request more time.
3. Without a service manager nothing is sent, and one that does not listen has no effect.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import MutableMapping

USUALLY_S = 2.0
"""Default period of the heartbeat, s, where the service manager requests none."""
WORDS_A_WATCH = 4.0
"""Signs of life in the time in which one is required."""
MORE_TIME = f"EXTEND_TIMEOUT_USEC={5e6 * USUALLY_S:.0f}"
"""Message that requests more time, and the requested time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ServiceManager:
    """A service manager.

    Attributes
    ----------
    address : str or None
        Of its socket; None without one.
    every_s : float
        Period of the heartbeat, s.
    """

    address: str | None = None
    every_s: float = USUALLY_S

    @classmethod
    def of(cls, environment: MutableMapping[str, str], pid: int) -> ServiceManager:
        """Return the one that started process `pid`; its variables are taken out, so that no process of ours speaks."""
        address, period_us, of = (
            environment.pop(name, "") for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
        )
        watched = period_us.isdecimal() and int(period_us) > 0 and of in {"", str(pid)}
        every_s = min(int(period_us) * 1e-6 / WORDS_A_WATCH, USUALLY_S) if watched else USUALLY_S
        return cls("\0" + address[1:] if address.startswith("@") else address or None, every_s)

    def notify(self, word: str) -> None:
        """Send a message; a service manager that does not listen is not waited for."""
        if self.address is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.setblocking(False)  # noqa: FBT003 - the name says it
            try:
                line.sendto(word.encode(), self.address)
            except OSError as error:
                _log.debug("the service manager did not receive %s: %s", word, error)


class Attendance:
    """Words to a service manager, from the start of the service to its end.

    Parameters
    ----------
    manager : ServiceManager
        The service manager.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._words: asyncio.Task[None] | None = None

    def starts(self) -> None:
        """Ask for time until the service is ready."""
        self._from_now_on(MORE_TIME)

    def is_ready(self) -> None:
        """Report readiness, and start the heartbeat."""
        self._manager.notify("READY=1")
        self._from_now_on("WATCHDOG=1")

    def stops(self) -> None:
        """Report the stop, and request time until the end."""
        self._manager.notify("STOPPING=1")
        self._from_now_on(MORE_TIME)

    async def end(self) -> None:
        """Stop all messages."""
        words, self._words = self._words, None
        if words is not None:
            words.cancel()
            await asyncio.wait([words])

    def _from_now_on(self, word: str) -> None:
        if self._manager.address is None:
            return
        if self._words is not None:
            self._words.cancel()
        self._words = asyncio.create_task(self._again_and_again(word))

    async def _again_and_again(self, word: str) -> None:
        while True:
            self._manager.notify(word)
            await asyncio.sleep(self._manager.every_s)
