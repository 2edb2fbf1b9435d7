"""A tuning as one file: request, recording, result and versions; and the same analysis again.

    {"autotuner_tuning": 1, "sha256": "..", "id": .., "loop": .., "started_at": .., "actor": .., "request": {..},
     "versions": {..}, "result": {..}, "events": [[number, {..}], ..], "gains": [..],
     "recording": {"settings": {..}, "t": [..], "pv": [..], "output": [..], ..}}

Invariants:

1. JSON text, whose numbers are reproduced bit by bit. `sha256` is that of all other content in canonical form: keys
   sorted, no spaces.
2. A file is bounded in size, and validated before use.
3. Results are compared, without times and identifiers.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from autotuner.application.analysis.analysed import context_from
from autotuner.application.computing.computations import analyse
from autotuner.core.design import design_spec_from
from autotuner.core.jsonable import jsonable
from autotuner.core.recording import Recording, Sample
from autotuner.errors import InputError, RecordingError
from autotuner.service.archive.storage.packed import FIELDS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from autotuner.service.archive.archive_record import KeptTuning

FORMAT = 1
"""Version of the form of an exported tuning; newer ones are refused."""
MARK = "autotuner_tuning"
LARGEST_BYTES = 256 * 1024 * 1024
"""Largest file that is read."""
COMPRESSED = (b"PK", b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")
"""First bytes of compressed files."""
NO_FILE = "Give a file of GET /v1/tunings/ID/export, as it was sent."


@dataclass(frozen=True, slots=True)
class Exported:
    """A tuning that was read from a file.

    Attributes
    ----------
    id : str
        Its identifier.
    request : mapping
        The requested `structure`, `goal` and `rule`.
    versions : mapping of str to str
        What analysed it then.
    result : mapping
        Its result.
    recording : Recording
        What was recorded.
    """

    id: str
    request: Mapping[str, Any]
    versions: Mapping[str, str]
    result: Mapping[str, Any]
    recording: Recording


def exported(kept: KeptTuning, gains: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return a tuning as the text of one file; `gains` are the changes of its device's gains."""
    columns = {name: [_plain(getattr(sample, name)) for sample in kept.samples] for name in FIELDS}
    content = jsonable({
        MARK: FORMAT,
        **asdict(kept.head),
        "versions": kept.versions,
        "result": kept.reported,
        "events": kept.events,
        "gains": list(gains),
        "recording": {"settings": kept.recording_settings, **columns},
    })  # fmt: skip
    assert isinstance(content, dict)  # noqa: S101 - a copy of a dict
    return json.dumps({"sha256": digest(content), **content}, allow_nan=False)


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of all other content of a file, in hex."""
    held = {name: part for name, part in content.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(held, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def read_export(file: Path) -> Exported:
    """Read an exported tuning.

    Raises
    ------
    RecordingError
        The file cannot be read, is too large, has another format, was changed, or has no recording.
    """
    name = str(file)
    try:
        with file.open("rb") as opened:
            content = opened.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise RecordingError(
            f"cannot be read: {error.strerror}", field=name, remedy="Check the path and its permissions."
        ) from error
    if len(content) > LARGEST_BYTES:
        raise RecordingError(f"is larger than {LARGEST_BYTES >> 20} MiB", field=name, remedy=NO_FILE)
    if content.startswith(COMPRESSED):
        raise RecordingError("is compressed", field=name, remedy="Unpack it first.")
    return _exported(_parsed(content, name), name)


def _parsed(content: bytes, name: str) -> dict[str, Any]:
    """Return the content of an exported file, unchanged since it was written."""
    try:
        whole = json.loads(content)
        known = int(whole[MARK])
        whole_as_written = whole["sha256"] == digest(whole)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _no_export(name, error) from error
    if known > FORMAT:
        raise RecordingError(f"is of format {known}, of a newer program", field=name, remedy="Use that one.")
    if not whole_as_written:
        raise RecordingError("was changed since it was written: its sha256 differs", field=name, remedy=NO_FILE)
    return dict(whole)


def _exported(content: Mapping[str, Any], name: str) -> Exported:
    try:
        held = content["recording"]
        rows = zip(*(held[column] for column in FIELDS), strict=True)
        samples = [Sample(*map(_number, row)) for row in rows]
        parts = (content[part] for part in ("request", "versions", "result"))
        request, versions, result = (_mapping(part) for part in parts)
        settings, tuning_id = _mapping(held["settings"]), str(content["id"])
    except (ValueError, KeyError, TypeError) as error:
        raise _no_export(name, error) from error
    return Exported(tuning_id, request, versions, result, Recording.from_samples(samples, settings))


def _no_export(name: str, error: Exception) -> RecordingError:
    return RecordingError(f"is no exported tuning ({type(error).__name__})", field=name, remedy=NO_FILE)


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: object) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _mapping(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError
    return value


@dataclass(frozen=True, slots=True)
class Replay:
    """The same analysis again.

    Attributes
    ----------
    result : mapping
        Its present result, JSON-ready.
    compared : tuple of str
        Parts of the result that were reported then.
    differing : tuple of str
        Results that differ in any digit.
    """

    result: Mapping[str, Any]
    compared: tuple[str, ...]
    differing: tuple[str, ...]


def replayed(tuning: Exported) -> Replay:
    """Analyse a recording as it was then, and compare.

    Raises
    ------
    InputError
        It cannot be analysed.
    """
    try:
        structure, _ = tuning.request["structure"], tuning.request["goal"]
    except KeyError as error:
        raise InputError(f"{error} is missing", field="request", remedy=NO_FILE) from error
    context = context_from(tuning.result.get("context"))
    spec, budget_ms = design_spec_from(tuning.request), tuning.request.get("budget_ms")
    analysis = analyse(tuning.recording, structure, spec, context, budget_ms)
    again = {**analysis.to_dict(), "verdict": analysis.verdict.to_dict()}
    result: dict[str, Any] = json.loads(json.dumps(jsonable(again)))
    then = _analysed(tuning.result)
    compared = tuple(name for name in result if name in then)
    return Replay(result, compared, tuple(name for name in compared if _text(then[name]) != _text(result[name])))


def _analysed(reported: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a tuning's result that follows from its recording alone; empty without an analysis.

    Its warnings are also of the test, and the verdict of one that was stopped is the stop's.
    """
    if "estimates" not in reported:
        return {}
    stopped = (reported.get("verdict") or {}).get("outcome") in {"aborted", "failed"}
    return {
        name: part
        for name, part in reported.items()
        if name not in {"warnings", "notes"} and not (stopped and name == "verdict")
    }


def _text(part: object) -> str:
    return json.dumps(part, sort_keys=True)
