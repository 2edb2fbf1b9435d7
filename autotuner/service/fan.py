"""The live events of one tuning, encoded once for all who watch it.

    event -> bytes of a chunk, once -> every viewer's connection

Rules of this file:

1. A viewer who has seen all so far costs one write of bytes that are there already, straight to its connection where
   that can be (`autotuner.service.straight`), and no task is woken for it; at most one in `PACE_S`.
2. A viewer whose connection does not take them at once falls behind: it goes on by itself, with at most `AT_ONCE`
   events at a time, until it has caught up. Nothing else is held for it, and it keeps nobody waiting.
3. The task that spreads the news lives as long as somebody watches who has seen all so far.
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from autotuner.service.straight import chunk

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import Message, Send

    from autotuner.runtime.events import Event
    from autotuner.runtime.tuning import Tuning
    from autotuner.service.context import Seen
    from autotuner.store.past import PastEvent

AT_ONCE = 500
"""Most events written together."""
PACE_S = 0.08
"""Shortest time between two writes to all, s: what a faster loop does meanwhile is written together."""
PING_S = 15.0
"""Longest silence, so that no proxy gives the connection up, s."""


def encoded(seen: Seen, first: int) -> tuple[Message, int]:
    """Return the events of a tuning from one on, `AT_ONCE` at most, and the index behind the last of them."""
    news = seen.events[first : first + AT_ONCE]
    body = b"".join(_encoded(index, event) for index, event in enumerate(news, first))
    return message(body), first + len(news)


def message(body: bytes, *, more: bool = True) -> Message:
    """Return a piece of an answer."""
    return {"type": "http.response.body", "body": body, "more_body": more}


def _encoded(index: int, event: Event | PastEvent) -> bytes:
    data = json.dumps(event.to_dict(), allow_nan=False)
    return format_sse_event(data_str=data, event=event.type, id=str(index))


@dataclass(frozen=True, slots=True)
class News:
    """What is written to all who have seen the same: as a message, as a chunk, and how many events they have then.

    `has` is None for a sign of life, which brings no event.
    """

    message: Message
    chunk: bytes
    has: int | None = None


PING = News(message(KEEPALIVE_COMMENT), chunk(KEEPALIVE_COMMENT))


@dataclass(frozen=True, slots=True)
class Line:
    """The way to a viewer: the usual one, and the straight one where there is one."""

    send: Send
    straight: Callable[[bytes], bool] | None = None

    def write(self, news: News) -> bool:
        """Write at once; return False, with nothing written, when the connection takes no more for now."""
        if self.straight is not None:
            return self.straight(news.chunk)
        sending = self.send(news.message).__await__()
        try:
            next(sending)
        except StopIteration:
            return True
        sending.close()  # it waits, and does so before anything is written
        return False


@dataclass(slots=True, eq=False)
class Viewer:
    """Somebody who watches: the way to him, how many events he has, and what tells that he is on his own."""

    line: Line
    has: int
    alone: asyncio.Future[None]

    def take(self, news: News) -> None:
        """Write at once what all get, or leave him on his own."""
        try:
            written = self.line.write(news)
        except Exception as error:  # noqa: BLE001 - it is this viewer's, and nobody else's
            self.leave(error)
            return
        if not written:
            self.leave()
        elif news.has is not None:
            self.has = news.has

    def leave(self, error: Exception | None = None) -> None:
        """Leave him on his own, with what went wrong."""
        if self.alone.done():
            return
        if error is None:
            self.alone.set_result(None)
        else:
            self.alone.set_exception(error)


class Fan:
    """The viewers of one running tuning who have seen all so far.

    Parameters
    ----------
    tuning : Tuning
        What they watch.
    """

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self._viewers: set[Viewer] = set()
        self._task: asyncio.Task[None] | None = None

    @property
    def watched(self) -> bool:
        """Whether anybody watches."""
        return bool(self._viewers)

    async def follow(self, line: Line, has: int) -> int:
        """Write what is new until the tuning has told all, or the viewer falls behind; return how many events he has.

        `has` is what he has now: all events so far.
        """
        viewer = Viewer(line, has, asyncio.get_running_loop().create_future())
        self._viewers.add(viewer)
        if self._task is None:
            self._task = asyncio.create_task(self._spread(), name=f"viewers-{self._tuning.id}")
        try:
            await viewer.alone
        finally:
            self._viewers.discard(viewer)
            if not self._viewers and self._task is not None:
                self._task.cancel()
                self._task = None
        return viewer.has

    async def _spread(self) -> None:
        while True:
            try:
                async with asyncio.timeout(PING_S):
                    await self._tuning.more(min(viewer.has for viewer in self._viewers))
            except TimeoutError:
                self._tell(lambda _: PING)
            else:
                await asyncio.sleep(0)  # what comes of it in the same moment goes with it
                self._tell_news()
            await asyncio.sleep(PACE_S)

    def _tell_news(self) -> None:
        known: dict[int, News] = {}

        def news(has: int) -> News:
            if has not in known:
                told, following = encoded(self._tuning, has)
                known[has] = News(told, chunk(told["body"]), following)
            return known[has]

        self._tell(news)
        if self._tuning.told_all:
            for viewer in self._viewers:
                viewer.leave()

    def _tell(self, what: Callable[[int], News]) -> None:
        for viewer in tuple(self._viewers):
            if not viewer.alone.done():
                viewer.take(what(viewer.has))


class Fans:
    """The fans of the tunings that are watched now."""

    def __init__(self) -> None:
        self._fans: dict[str, Fan] = {}

    async def watch(self, tuning: Tuning, line: Line, has: int) -> int:
        """Follow a tuning with all the others who watch it; see `Fan.follow`."""
        fan = self._fans.setdefault(tuning.id, Fan(tuning))
        try:
            return await fan.follow(line, has)
        finally:
            if not fan.watched:
                self._fans.pop(tuning.id, None)
