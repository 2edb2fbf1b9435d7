"""`/v1/tunings/{id}/events`: everything that happens in a tuning, from the first sample, as server-sent events.

Rules of this file:

1. The index of an event in its tuning is its `id`; `Last-Event-ID` goes on behind it: a broken connection loses none.
2. What is new is written at once and together; the framework's own way of streaming is not used, because it takes a
   reader that goes away for a fault.
3. The stream ends with the tuning, after the event ``ended``; who comes back for more gets 204, which stops a browser.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from starlette.exceptions import HTTPException
from starlette.responses import StreamingResponse

from autotuner.errors import InputError, UnknownTuningError
from autotuner.runtime.events import Event
from autotuner.runtime.tuning import Tuning
from autotuner.service.context import Seen, SeenOf
from autotuner.service.problems import documented
from autotuner.store.past import PastEvent

PATH = "/v1/tunings/{tuning_id}/events"

router = APIRouter(tags=["tunings"])

LastSeen = Annotated[int, Header(alias="Last-Event-ID", ge=-1, description="Index of the last event received.")]

AT_ONCE = 500
"""Most events written together."""
PING_S = 15.0
"""Longest silence, so that no proxy gives the connection up, s."""

NO_MORE: dict[int | str, dict[str, Any]] = {204: {"description": "The tuning has ended and everything was received"}}


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


async def _unfinished(tuning: SeenOf, last_event_id: LastSeen = -1) -> Seen:
    if tuning.told_all and last_event_id + 1 >= len(tuning.events):
        raise HTTPException(HTTPStatus.NO_CONTENT)
    return tuning


@router.get(
    PATH,
    response_class=EventStream,
    responses=NO_MORE | documented(UnknownTuningError, InputError),
)
async def follow_tuning(tuning: Annotated[Seen, Depends(_unfinished)], last_event_id: LastSeen = -1) -> EventStream:
    """Follow a tuning: each sample, phase, running estimate, link trouble, the restore and the end, as JSON."""
    return EventStream(_stream(tuning, last_event_id + 1), headers={"Cache-Control": "no-cache"})


async def _stream(tuning: Seen, seen: int) -> AsyncIterator[bytes]:
    while True:
        news = tuning.events[seen : seen + AT_ONCE]
        if news:
            yield b"".join(_encoded(index, event) for index, event in enumerate(news, seen))
            seen += len(news)
            await asyncio.sleep(0)  # a long record is told in turns with other answers
        elif tuning.told_all or not isinstance(tuning, Tuning):
            return
        else:
            try:
                async with asyncio.timeout(PING_S):
                    await tuning.more(seen)
            except TimeoutError:
                yield KEEPALIVE_COMMENT


def _encoded(index: int, event: Event | PastEvent) -> bytes:
    data = json.dumps(event.to_dict(), allow_nan=False)
    return format_sse_event(data_str=data, event=event.type, id=str(index))
