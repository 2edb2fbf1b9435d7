"""`/v1/tunings/{id}/events`: everything that happens in a tuning, from the first sample, as server-sent events.

Invariants:

1. The index of an event in its tuning is its `id`; `Last-Event-ID` continues after it: a broken connection loses none.
2. Each viewer has its own generator, which the framework's `StreamingResponse` sends; FastAPI encodes the events.
   A slow viewer delays only itself and needs no buffer: the generator reads the tuning's own
   list of events. FastAPI's `EventSourceResponse` sends each event separately, which makes a long record slow to open.
3. The stream ends with the tuning, after the event ``ended``; a request for more gets 204, which stops a browser.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Depends, Header
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from starlette.exceptions import HTTPException
from starlette.responses import StreamingResponse

from autotuner.control.verification.verification_run import VerificationRun
from autotuner.errors import InputError, TuningStateError, UnknownTuningError
from autotuner.service.archive.archived_tuning import ArchivedTuning
from autotuner.service.context import Seen, SeenOf, TuningOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.control.reporting.events import Event
    from autotuner.control.verification.verification_events import VerificationEvent
    from autotuner.service.archive.archived_tuning import ArchivedEvent

PATH = "/v1/tunings/{tuning_id}/events"
VERIFICATION_PATH = "/v1/tunings/{tuning_id}/verification/events"

router = APIRouter(tags=["tunings"])

LastSeen = Annotated[int, Header(alias="Last-Event-ID", ge=-1, description="Index of the last event received.")]

NO_MORE: dict[int | str, dict[str, Any]] = {204: {"description": "The tuning has ended and everything was received"}}


AT_ONCE = 500
"""Most events of one write: a long record is sent in turns with other answers."""
PACE_S = 0.08
"""Shortest time between two writes to a viewer, s: the events of a faster loop are written together."""
PING_S = 15.0
"""Longest silence, s, so that no proxy closes the connection."""


class EventStream(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


async def _stream(seen: Seen | VerificationRun, first: int) -> AsyncIterator[bytes]:
    """Yield the events from index `first` on until all has ended, and a comment where it is silent."""
    while True:
        news = seen.events[first : first + AT_ONCE]
        if news:
            yield b"".join(_encoded(index, event) for index, event in enumerate(news, first))
            first += len(news)
        elif seen.end_published or isinstance(seen, ArchivedTuning):
            return
        if len(news) < AT_ONCE and not isinstance(seen, ArchivedTuning) and not seen.end_published:
            await asyncio.sleep(PACE_S)
            try:
                async with asyncio.timeout(PING_S):
                    await seen.more(first)
            except TimeoutError:
                yield KEEPALIVE_COMMENT
            await asyncio.sleep(0)  # other events of the same moment are written with the one that rang


def _encoded(index: int, event: "Event | ArchivedEvent | VerificationEvent") -> bytes:
    data = json.dumps(event.to_dict(), allow_nan=False)
    return format_sse_event(data_str=data, event=event.type, id=str(index))


async def _unfinished(tuning: SeenOf, last_event_id: LastSeen = -1) -> Seen:
    if tuning.end_published and last_event_id + 1 >= len(tuning.events):
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


async def _verification(tuning: TuningOf, last_event_id: LastSeen = -1) -> VerificationRun:
    run = tuning.verification
    if run is None:
        raise TuningStateError(
            "has no verification", field="tuning", value=tuning.id, remedy="Apply its gains, then verify them."
        )
    if run.end_published and last_event_id + 1 >= len(run.events):
        raise HTTPException(HTTPStatus.NO_CONTENT)
    return run


@router.get(
    VERIFICATION_PATH,
    response_class=EventStream,
    responses=NO_MORE | documented(UnknownTuningError, TuningStateError, InputError),
)
async def follow_verification(
    run: Annotated[VerificationRun, Depends(_verification)], last_event_id: LastSeen = -1
) -> EventStream:
    """Follow the latest verification: its phases, the gains written, the step with its band, samples, the verdict."""
    return EventStream(_stream(run, last_event_id + 1), headers={"Cache-Control": "no-cache"})
