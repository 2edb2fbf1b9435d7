"""`/v1/tunings/{id}/events`: everything that happens in a tuning, from the first sample, as server-sent events.

Rules of this file:

1. The index of an event in its tuning is its `id`; `Last-Event-ID` goes on behind it: a broken connection loses none.
2. The stream ends with the tuning, after the event ``ended``; who comes back for more gets 204, which stops a browser.
"""

import json
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.exceptions import HTTPException

from autotuner.errors import InputError, UnknownTuningError
from autotuner.service.context import Seen, SeenOf
from autotuner.service.problems import documented

PATH = "/v1/tunings/{tuning_id}/events"

router = APIRouter(tags=["tunings"])

LastSeen = Annotated[int, Header(alias="Last-Event-ID", ge=-1, description="Index of the last event received.")]

NO_MORE: dict[int | str, dict[str, Any]] = {204: {"description": "The tuning has ended and everything was received"}}


async def _unfinished(tuning: SeenOf, last_event_id: LastSeen = -1) -> Seen:
    if tuning.told_all and last_event_id + 1 >= len(tuning.events):
        raise HTTPException(HTTPStatus.NO_CONTENT)
    return tuning


@router.get(
    PATH,
    response_class=EventSourceResponse,
    responses=NO_MORE | documented(UnknownTuningError, InputError),
)
async def follow_tuning(
    tuning: Annotated[Seen, Depends(_unfinished)], last_event_id: LastSeen = -1
) -> AsyncIterator[ServerSentEvent]:
    """Follow a tuning: each sample, phase, running estimate, link trouble, the restore and the end, as JSON."""
    index = 0
    async for event in tuning.follow():
        if index > last_event_id:
            data = json.dumps(event.to_dict(), allow_nan=False)
            yield ServerSentEvent(raw_data=data, event=event.type, id=str(index))
        index += 1
