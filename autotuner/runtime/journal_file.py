"""What stands in a journal: one JSON object a line, in the order in which it happened.

    {"journal": 1, "kind": "tuning", "tuning": "..", "loop": "..", "device": "<hash>", "started_at": "..", ..}
    {"before": {"output": 40.0, "auto": null, ..}}     from here on the loop may be disturbed
    {"command": 53.3}                                  about to be written to the device
    {"target": 40.0}                                   where it is about to be given back to
    {"t": 12.3, "phase": "relay"}
    {"sample": [t, pv, output, set point, lateness, written at]}
    {"ended": {"outcome": .., "code": .., ..}}
    {"left": {"outcome": .., "code": .., ..}}          instead: why it ended, with a loop that could not be given back

of a verification, which writes gains and moves a set point, and of a run over operating points, which moves one:

    {"gains": "unproved"}                              the device may hold new ones that nobody has verified
    {"gains": "proved"}                                they stay
    {"set_point": 82.0}                                about to be written to the device
    {"mode": 1.0}                                      about to be written; what is commanded counts from here anew
    {"point": "<id of a tuning>"}                      begun at an operating point
    {"undone": {"at": .., "was": {..}, "now": {..}}}   the old gains are back
    {"given_back": ".."}                               by a process that stood by, in words for the next start

of gains that are written, or put back, by themselves:

    {"gains": "unproved", "change": "..", "found": {..}}    a change of the ledger is under way, from what was found
    {"gains": "proved"}                                what the device holds stays

Rules of this file:

1. A line counts when it is whole: what the end of a killed program left of its last line is dropped.
2. A journal without `ended` was interrupted, or has left its loop as it is: the next start goes on with it.
3. A journal without a kind is of a tuning.
"""

from __future__ import annotations

import json
import math
from dataclasses import astuple, dataclass, field, fields
from enum import StrEnum
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
"""Code of the verdict of what was interrupted and made good later."""
PROVED, UNPROVED = "proved", "unproved"
TAIL_BYTES = 4096


class Kind(StrEnum):
    """What a journal is of."""

    TUNING = "tuning"
    VERIFICATION = "verification"
    SCHEDULE = "schedule"
    GAINS = "gains"


def line(entry: Mapping[str, object]) -> bytes:
    """Return an entry as a line of the file."""
    return json.dumps(jsonable(entry), allow_nan=False).encode() + b"\n"


def sample_entry(sample: Sample) -> dict[str, object]:
    """Return the entry of a sample."""
    return {"sample": list(astuple(sample))}


@dataclass(slots=True)
class Kept:
    """What a journal tells of its tuning, its verification, its run over operating points, or its change of gains.

    Attributes
    ----------
    path : Path
        The file.
    tuning, loop, device, started_at : str
        Whose it is; `device` is the `device_key` of its loop then. Of a run over operating points, its identifier; of
        gains that no tuning has made, what was done with them.
    request : mapping
        How it was asked for.
    before : Before or None
        How the loop was found; None while it cannot have been disturbed.
    kind : Kind
        What it is of.
    commanded : set of float
        Every output that was about to be written, output units; of a verification, in manual on the way back.
    target : float or None
        The output at which it was to end, once that was decided: the one before, or the declared safe one.
    set_points : set of float
        The set point as it was found, and each that was about to be written, PV units.
    mode : float or None
        The mode that was about to be written last.
    proved : bool or None
        Whether the gains that it wrote are to stay; None where it writes none.
    change : str or None
        The change of the ledger that was under way, by the time at which it began; None but for gains by themselves.
    found : mapping of str to float
        Number of each signal before that.
    points : list of str
        The tunings that a run over operating points began.
    undone : mapping or None
        How the old gains came back after it was interrupted: when, and the number of each signal before and now.
    left : Verdict or None
        Why it ended, where that was with a loop that could not be given back; None where its program was killed.
    given_back : str or None
        How the loop was given back after it was interrupted, where that is still to be told.
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
    kind: Kind = Kind.TUNING
    commanded: set[float] = field(default_factory=set)
    target: float | None = None
    set_points: set[float] = field(default_factory=set)
    mode: float | None = None
    proved: bool | None = None
    change: str | None = None
    found: Mapping[str, float] = field(default_factory=dict)
    points: list[str] = field(default_factory=list)
    undone: Mapping[str, Any] | None = None
    left: Verdict | None = None
    given_back: str | None = None
    restored: bool = False
    verdict: Verdict | None = None
    samples: list[Sample] = field(default_factory=list)

    @property
    def after(self) -> str:
        """After what its loop is given back, in words."""
        return "at a later try" if self.left else "after a kill"

    @property
    def settings(self) -> ExperimentSettings:
        """How the experiment was run."""
        return settings_of(self.request["settings"])

    def take(self, entry: Mapping[str, Any]) -> None:
        """Take the next line."""
        match entry:
            case {"before": before}:
                self._find(Before(**before))
            case {"command": output}:
                self.commanded.add(output)
            case {"target": output}:
                self._aim(output)
            case {"phase": phase}:
                self.restored = phase == Phase.ENDED
            case {"sample": values}:
                self.samples.append(Sample(*(math.nan if value is None else value for value in values)))
            case {"ended": verdict}:
                self.verdict, self.restored = _verdict(verdict), True
            case {"left": verdict}:
                self.left = _verdict(verdict)
            case _:
                self._take_of_set_points(entry)

    def _take_of_set_points(self, entry: Mapping[str, Any]) -> None:
        """Take a line of a verification, or of a run over operating points."""
        match entry:
            case {"set_point": set_point}:
                self.set_points.add(set_point)
            case {"mode": mode}:
                self.mode, self.commanded = mode, set()
            case {"gains": gains}:
                self.proved = gains == PROVED
                self.change, self.found = entry.get("change", self.change), entry.get("found", self.found)
            case {"point": tuning}:
                self.points.append(tuning)
            case {"undone": undone}:
                self.undone = undone
            case {"given_back": what}:
                self.given_back, self.restored = what, True

    def _find(self, before: Before) -> None:
        self.before = before
        if before.set_point is None:
            self._aim(before.output)
        else:
            self.set_points.add(before.set_point)

    def _aim(self, output: float) -> None:
        self.target = output
        self.commanded.add(output)


def _verdict(values: Mapping[str, Any]) -> Verdict:
    return Verdict(**{**values, "outcome": Outcome(values["outcome"])})


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
    named = {name: first[name] for name in ("tuning", "loop", "device", "started_at", "request")}
    kept = Kept(path, **named, kind=Kind(first.get("kind", Kind.TUNING)))
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
