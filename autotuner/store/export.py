"""A tuning as one file: what was asked, recorded and found; and the same analysis again.

Rules of this file: the file is JSON, whose numbers come back bit by bit; what is compared are the results, not their
texts.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from autotuner.core.recording import Recording, Sample
from autotuner.errors import RecordingError
from autotuner.runtime.analysis import analyse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.runtime.analysis import Analysis

FORMAT = 1
COLUMNS = ("t", "pv", "output", "set_point", "lateness_s", "written_s")
RESULTS = ("structure", "model", "recommended", "fit", "error", "gains", "limit_cycle", "estimates")
"""Parts of a tuning that follow from its recording and its request."""


def exported(
    told: Mapping[str, Any], request: Mapping[str, Any], settings: Mapping[str, Any], samples: Sequence[Sample]
) -> str:
    """Return a tuning as the text of one file.

    Parameters
    ----------
    told : mapping
        What it tells, as `Tuning.to_dict` does.
    request : mapping
        `structure`, `goal` and `rule` that were asked.
    settings : mapping
        Of the recording: the parts of the experiment.
    samples : sequence of Sample
        What was recorded.
    """
    columns = {name: [_plain(getattr(sample, name)) for sample in samples] for name in COLUMNS}
    whole = {"autotuner_tuning": FORMAT, "request": dict(request), "told": dict(told)}
    return json.dumps({**whole, "recording": {"settings": dict(settings), **columns}}, allow_nan=False)


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def read_export(text: str, name: str = "tuning") -> tuple[dict[str, Any], dict[str, Any], Recording]:
    """Return request, result and recording of an exported tuning.

    Raises
    ------
    RecordingError
        It is no such file, or nothing was recorded.
    """
    try:
        whole = json.loads(text)
        held = whole["recording"]
        rows = zip(*(held[column] for column in COLUMNS), strict=True)
        samples = [Sample(*(math.nan if v is None else float(v) for v in row)) for row in rows]
        request, told, settings = dict(whole["request"]), dict(whole["told"]), dict(held["settings"])
        newer = int(whole["autotuner_tuning"]) > FORMAT
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"is no exported tuning ({type(error).__name__}: {error})",
            field=name,
            remedy="Give a file of GET /v1/tunings/ID/export or of autotuner tune --export.",
        ) from error
    if newer:
        raise RecordingError("was written by a newer program", field=name, remedy="Use that one.")
    return request, told, Recording.from_samples(samples, settings)


def analysed_again(request: Mapping[str, Any], recording: Recording) -> Analysis:
    """Return what a recording tells, asked as it was then."""
    return analyse(recording, request["structure"], request["goal"], request["rule"])


def differing(told: Mapping[str, Any], again: Mapping[str, Any]) -> list[str]:
    """Return the parts of the result that are not what they were; none on the same machine with the same versions."""
    plain = json.loads(json.dumps(again))
    return [part for part in RESULTS if told.get(part) != plain.get(part)]
