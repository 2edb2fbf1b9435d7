"""Computations of the service's worker processes: reading, identification, curves and reports of recordings.

Invariants:

1. Every worker imports this module, so it imports no web framework.
2. The service imports it too, so dependencies of the computations are imported where they run.
"""

from __future__ import annotations

import json
import math
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from autotuner.core.model.process import model_from_dict
from autotuner.core.notes import notes_among, warnings_among
from autotuner.core.recording import Recording
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.core.design import DesignSpec

P = ParamSpec("P")
R = TypeVar("R")

UPLOAD = "recording"
"""Name of an uploaded recording in messages."""
MOST_LINES = 500_000
"""Longest recording that is worked on here: an hour at 100 Hz is 360,000 lines, and uploads wait for each other."""
MOST_CELLS = 3_000_000
"""Most separators of a recording: a cell takes up to 60 bytes of a worker's memory during parsing."""
MOST_COLUMNS = 1000
"""Most columns of a recording."""
SEPARATORS = (b",", b";", b"\t")
ABSURD = (ArithmeticError, np.linalg.LinAlgError, MemoryError)
"""Exceptions of a computation on numbers that no process has."""
SHORTEST_S = 1e-6
"""Shortest recording: less is a time that is not in seconds."""


def refuses_absurd_numbers(function: Callable[P, R]) -> Callable[P, R]:
    """Return a computation that refuses a recording where its numbers cannot be computed with."""

    @wraps(function)
    def computed(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except ABSURD as error:
            raise RecordingError(
                f"holds numbers that cannot be computed with ({type(error).__name__})",
                field=UPLOAD,
                remedy="Look for outliers in output and PV, and remove those rows.",
            ) from error

    return computed


@refuses_absurd_numbers
def identify_csv(
    content: bytes,
    columns: Mapping[str, str],
    structure: str,
    known_gain: float | None,
    spec: DesignSpec,
    points: int | None = None,
    moments: str = "auto",
    window_s: tuple[float, float] | None = None,
    disturbances: tuple[str, ...] = (),
) -> dict[str, object]:
    """Identify a CSV recording, JSON-ready; with `points` also curves of at most this many points, and all goals.

    A model that leaves much of the PV's motion unexplained gets no gains.

    Raises
    ------
    InputError
        The recording or a choice cannot be used.
    """
    from autotuner.application.analysis.basis import basis_of  # noqa: PLC0415
    from autotuner.application.analysis.learned import learned_models  # noqa: PLC0415
    from autotuner.core.design import design_from_spec, with_prediction  # noqa: PLC0415
    from autotuner.core.identification import identify  # noqa: PLC0415 - rule 2
    from autotuner.reports.choices import choices_of  # noqa: PLC0415
    from autotuner.reports.curves import fit_curves  # noqa: PLC0415

    recording = _read(content, columns)
    recording = recording if window_s is None else recording.window(*window_s)
    identification = identify(recording, structure, known_gain, moments, learned_models(), disturbances)
    usable = identification.model is not None and not identification.is_a_guess
    interval_s = recording.sample_interval_s
    shown = identification.recording if identification.disturbances else None
    basis = basis_of(identification, interval_s=interval_s) if usable else None
    chosen = with_prediction(design_from_spec(basis, spec), basis) if basis else None
    return {
        **identification.to_dict(),
        "gains": chosen.gains.to_dict() if chosen else None,
        "tuning": chosen.to_dict() if chosen else None,
        "warnings": [*warnings_among(identification.warnings), *(chosen.warnings if chosen else ())],
        "samples": len(recording),
        "duration_s": recording.duration_s,
        "notes": [*recording.notes, *notes_among(identification.warnings)],
        "curves": fit_curves(shown or recording, identification.model, points) if points else None,
        "choices": choices_of(basis, spec) if points and basis else None,
    }


@refuses_absurd_numbers
def diagnose_csv(
    content: bytes,
    columns: Mapping[str, str],
    declared: Mapping[str, object] | None,
    points: int | None = None,
    time_limit_s: float | None = None,
) -> dict[str, object]:
    """Diagnose a CSV recording, JSON-ready; with `points` also curves of at most this many points.

    `declared` is the model by its parameters.

    Raises
    ------
    InputError
        The recording or the model cannot be used.
    """
    from autotuner.application.analysis.diagnosis import diagnose  # noqa: PLC0415 - rule 2
    from autotuner.reports.curves import before_and_after  # noqa: PLC0415

    model = None if declared is None else model_from_dict(declared)
    diagnosis = diagnose(_read(content, columns), model, time_limit_s=time_limit_s)
    drawn = before_and_after(diagnosis.traces, points) if points and diagnosis.traces else None
    return {**diagnosis.to_dict(), "curves": drawn}


def _check_size(content: bytes) -> None:
    """Refuse a table that is too large to be read cell by cell, before it is read."""
    cells = max(content.count(separator) for separator in SEPARATORS)
    first = content[: content.find(b"\n") + 1] or content
    columns = max(first.count(separator) for separator in SEPARATORS) + 1
    for what, found, most in (("cells", cells, MOST_CELLS), ("columns", columns, MOST_COLUMNS)):
        if found > most:
            raise RecordingError(
                f"has more than {most} {what}", field=UPLOAD, value=found, remedy="Leave out columns, or thin it out."
            )


def _read(content: bytes, columns: Mapping[str, str]) -> Recording:
    if (lines := content.count(b"\n")) > MOST_LINES:
        raise RecordingError(
            f"has more than {MOST_LINES} lines",
            field=UPLOAD,
            value=lines,
            remedy="Thin it out, or give it to `autotuner identify` on a machine of yours.",
        )
    _check_size(content)
    with np.errstate(invalid="ignore", over="ignore"):  # non-finite values are refused or omitted
        recording = Recording.from_csv_bytes(content, UPLOAD, columns)
    if recording.duration_s < SHORTEST_S:
        raise RecordingError("lasts no time", field=UPLOAD, value=recording.duration_s, remedy="Give t in seconds.")
    return recording


def render_json(recording: Recording) -> str:
    """Return a recording by columns as JSON; null where the loop was open."""
    set_point = None if recording.set_point is None else recording.set_point.tolist()
    columns = {
        "t_s": recording.t.tolist(),
        "output": recording.output.tolist(),
        "pv": recording.pv.tolist(),
        "written_s": None if recording.written_s is None else recording.written_s.tolist(),
        "set_point": set_point and [value if math.isfinite(value) else None for value in set_point],
        "settings": dict(recording.settings),
        "notes": list(recording.notes),
    }
    return json.dumps(columns, allow_nan=False)
