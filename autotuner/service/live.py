"""`/v1/tunings/{id}/events`: everything that happens in a tuning, from the first sample, as server-sent events.

Rules of this file:

1. The index of an event in its tuning is its `id`; `Last-Event-ID` goes on behind it: a broken connection loses none.
2. What is new is written at once and together, encoded once for all who watch (`autotuner.service.fan`). The
   framework's own way of streaming is not used: it takes a reader that goes away for a fault.
3. The stream ends with the tuning, after the event ``ended``; who comes back for more gets 204, which stops a browser.
"""

import asyncio
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from autotuner.errors import InputError, UnknownTuningError
from autotuner.runtime.tuning import Tuning
from autotuner.service.context import FansOf, Seen, SeenOf
from autotuner.service.fan import Fans, Line, encoded, message
from autotuner.service.problems import documented
from autotuner.service.straight import STRAIGHT

PATH = "/v1/tunings/{tuning_id}/events"

router = APIRouter(tags=["tunings"])

LastSeen = Annotated[int, Header(alias="Last-Event-ID", ge=-1, description="Index of the last event received.")]

NO_MORE: dict[int | str, dict[str, Any]] = {204: {"description": "The tuning has ended and everything was received"}}


class EventStream(Response):
    """Server-sent events of one tuning, from one on until it has told all or the viewer goes away."""

    media_type = "text/event-stream"

    def __init__(self, seen: Seen, first: int, fans: Fans, status_code: int = 200) -> None:
        super().__init__(status_code=status_code, headers={"Cache-Control": "no-cache"})
        del self.headers["content-length"]
        self._seen, self._first, self._fans = seen, first, fans

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        line = Line(send, scope.get(STRAIGHT))
        telling, leaving = asyncio.create_task(self._tell(line)), asyncio.create_task(_left(receive))
        try:
            await asyncio.wait((telling, leaving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            telling.cancel()
            leaving.cancel()
            told = (await asyncio.gather(telling, leaving, return_exceptions=True))[0]
        if isinstance(told, Exception) and not isinstance(told, OSError):  # who went away is no fault
            raise told

    async def _tell(self, line: Line) -> None:
        seen, has = self._seen, self._first
        while True:
            news, following = encoded(seen, has)
            if following > has:
                await line.send(news)
                has = following
                await asyncio.sleep(0)  # a long record is told in turns with other answers
            elif seen.told_all or not isinstance(seen, Tuning):
                break
            else:
                has = await self._fans.watch(seen, line, has)
        await line.send(message(b"", more=False))


async def _left(receive: Receive) -> None:
    """Return when the viewer has gone."""
    while (await receive())["type"] != "http.disconnect":
        pass


async def _unfinished(tuning: SeenOf, last_event_id: LastSeen = -1) -> Seen:
    if tuning.told_all and last_event_id + 1 >= len(tuning.events):
        raise HTTPException(HTTPStatus.NO_CONTENT)
    return tuning


@router.get(
    PATH,
    response_class=EventStream,
    responses=NO_MORE | documented(UnknownTuningError, InputError),
)
async def follow_tuning(
    tuning: Annotated[Seen, Depends(_unfinished)], fans: FansOf, last_event_id: LastSeen = -1
) -> EventStream:
    """Follow a tuning: each sample, phase, running estimate, link trouble, the restore and the end, as JSON."""
    return EventStream(tuning, last_event_id + 1, fans)
