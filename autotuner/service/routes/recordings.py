"""`/v1/tunings/{id}/recording`: the samples, as CSV or JSON.

Rendering a long recording takes seconds, so it is arithmetic: never on the control loop's time.
"""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Response

from autotuner.core.recording import Recording
from autotuner.errors import InputError, RecordingError, TuningStateError, UnknownTuningError
from autotuner.service.computations import render_json
from autotuner.service.context import ComputationsOf, SeenOf
from autotuner.service.problems import documented
from autotuner.service.schemas import resources

router = APIRouter(prefix="/v1", tags=["tunings"])

CSV, JSON = "text/csv", "application/json"
RENDERED: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The recording",
        "model": resources.Recording,
        "content": {CSV: {"schema": {"type": "string"}, "example": "t,u,y\n0.0,40.0,80.0\n0.1,40.0,80.1\n"}},
    }
}


@router.get(
    "/tunings/{tuning_id}/recording",
    response_class=Response,
    responses=RENDERED | documented(UnknownTuningError, TuningStateError, InputError),
)
async def get_recording(
    tuning: SeenOf,
    computations: ComputationsOf,
    form: Annotated[Literal["csv", "json"] | None, Query(alias="format")] = None,
    accept: Annotated[str, Header(include_in_schema=False)] = "*/*",
) -> Response:
    """Return the recording so far: CSV, or JSON when `format` or `Accept` requests it."""
    try:
        recording = tuning.recording()
    except RecordingError as error:
        raise TuningStateError(
            "has not recorded two samples", field="tuning", value=tuning.id, remedy="Check its phase or its verdict."
        ) from error
    as_json = form == "json" or (form is None and weight(accept, JSON) > weight(accept, CSV))
    render, media_type = (render_json, JSON) if as_json else (Recording.to_csv, CSV)
    return Response(await computations.run(render, recording), media_type=media_type, headers={"Vary": "Accept"})


def weight(accept: str, media_type: str) -> float:
    """Return the weight that an `Accept` header gives to a media type (RFC 9110, section 12.5.1)."""
    weights = {}
    for entry in accept.lower().split(","):
        media_range, *parameters = (part.strip() for part in entry.split(";"))
        weights[media_range] = next((_number(part[2:]) for part in parameters if part.startswith("q=")), 1.0)
    ranges = (media_type, f"{media_type.partition('/')[0]}/*", "*/*")
    return next((weights[media_range] for media_range in ranges if media_range in weights), 0.0)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0
