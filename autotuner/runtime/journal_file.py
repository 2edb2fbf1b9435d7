"""What stands in a journal: one JSON object a line, in the order in which it happened.

    {"journal": 1, "tuning": "..", "loop": "..", "device": "<hash>", "started_at": "..", "request": {..}}
    {"before": {"output": 40.0, "auto": null}}         from here on the loop may be disturbed
    {"command": 53.3}                                  about to be written to the device
    {"target": 40.0}                                   where it is about to be given back to
    {"t": 12.3, "phase": "relay"}
    {"sample": [t, pv, output, set point, lateness, written at]}
    {"ended": {"outcome": .., "code": .., ..}}

Rules of this file:

1. A line counts when it is whole: what the end of a killed program left of its last line is dropped.
2. A journal without `ended` was interrupted.
"""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass, field, fields
from typing import TYPE_CHECKING, Any

from autotuner.core.jsonable import jsonable
from autotuner.core.phases import Phase
from autotuner.core.recording import Sample
from autotuner.core.settings import ExperimentSettings, Limits
from autotuner.core.verdict import Outcome, Verdict
from autotuner.runtime.restore import Before

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

VERSION = 1
INTERRUPTED = "interrupted"
"""Code of the verdict of a tuning that was interrupted and made good later."""
TAIL_BYTES = 4096


def line(entry: Mapping[str, object]) -> bytes:
    """Return an entry as a line of the file."""
    return json.dumps(jsonable(entry), allow_nan=False).encode() + b"\n"


def sample_entry(sample: Sample) -> dict[str, object]:
    """Return the entry of a sample."""
    return {"sample": list(astuple(sample))}


@dataclass(slots=True)
class Kept:
    """What a journal tells of its tuning.

    Attributes
    ----------
    path : Path
        The file.
    tuning, loop, device, started_at : str
        Whose it is; `device` is the `device_key` of its loop then.
    request : mapping
        How the tuning was asked for.
    before : Before or None
        How the loop was found; None while it cannot have been disturbed.
    commanded : set of float
        Every output that was about to be written, output units.
    target : float or None
        The output at which it was to end, once that was decided: the one before, or the declared safe one.
    restored : bool
        Whether the loop had been given back.
    verdict : Verdict or None
        How it ended; None when it was interrupted.
    samples : list of Sample
        The recording.
    """

    path: Path
    tuning: str
    loop: str
    device: str
    started_at: str
    request: Mapping[str, Any]
    before: Before | None = None
    commanded: set[float] = field(default_factory=set)
    target: float | None = None
    restored: bool = False
    verdict: Verdict | None = None
    samples: list[Sample] = field(default_factory=list)

    @property
    def settings(self) -> ExperimentSettings:
        """How the experiment was run."""
        return settings_of(self.request["settings"])

    def take(self, entry: Mapping[str, Any]) -> None:
        """Take the next line."""
        match entry:
            case {"before": before}:
                self.before = Before(before["output"], before["auto"])
                self._aim(before["output"])
            case {"command": output}:
                self.commanded.add(output)
            case {"target": output}:
                self._aim(output)
            case {"phase": phase}:
                self.restored = phase == Phase.ENDED
            case {"sample": values}:
                self.samples.append(Sample(*(math.nan if value is None else value for value in values)))
            case {"ended": verdict}:
                self.verdict = Verdict(**verdict | {"outcome": Outcome(verdict["outcome"])})

    def _aim(self, output: float) -> None:
        self.target = output
        self.commanded.add(output)


def settings_of(values: Mapping[str, Any]) -> ExperimentSettings:
    """Return the settings of which `ExperimentSettings.to_dict` made the values."""
    limits = dict(values["limits"])
    low, high = limits["pv"]
    limits["output"] = tuple(limits["output"])
    limits["pv"] = (-math.inf if low is None else low, math.inf if high is None else high)
    limits["output_slew_per_s"] = limits["output_slew_per_s"] or math.inf
    known = {f.name for f in fields(ExperimentSettings)} & set(values)
    return ExperimentSettings(**{name: values[name] for name in known} | {"limits": Limits(**limits)})


def read_journal(path: Path) -> Kept:
    """Read a journal.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It is none.
    """
    first, *others = [json.loads(text) for text in path.read_bytes().split(b"\n")[:-1]]
    if first.get("journal") != VERSION:
        raise ValueError(f"{path} is not a journal of version {VERSION}")
    kept = Kept(path, **{name: first[name] for name in ("tuning", "loop", "device", "started_at", "request")})
    for entry in others:
        kept.take(entry)
    return kept


def last_entry(path: Path) -> Mapping[str, Any]:
    """Return the last whole line of a journal; reads no more than its end."""
    with path.open("rb") as file:
        file.seek(0, 2)
        file.seek(max(file.tell() - TAIL_BYTES, 0))
        lines = file.read().split(b"\n")[:-1]
    last: Mapping[str, Any] = json.loads(lines[-1]) if lines else {}
    return last


def whole_bytes(path: Path) -> int:
    """Return the length of a journal up to the end of its last whole line."""
    return path.read_bytes().rfind(b"\n") + 1
