"""Record of a lease in the store: of a tuning, a verification, a run over set points, or a change of gains.

    {"record": 2, "kind": "tuning", "tuning": "..", "loop": "..", "device": "<hash>", "started_at": "..", ..}  the lease

its entries, in chronological order:

    {"before": {"output": 40.0, "auto": null, ..}}     from here on the loop may be disturbed
    {"command": 53.3}                                  a level beyond those before, about to be written to the device
    {"target": 40.0}                                   the output to which a restore begins
    {"t": 12.3, "phase": "relay"}
    {"ended": {"outcome": .., "code": .., ..}}
    {"left": {"outcome": .., "code": .., ..}}          instead: the reason of the end, with a loop that was not restored

of a verification, which writes gains and moves a set point, and of a run over operating points, which moves one:

    {"gains": "unproved"}                              the device may hold new gains that have not been verified
    {"gains": "proved"}                                the new gains are kept
    {"set_point": 82.0}                                about to be written to the device
    {"mode": 1.0}                                      about to be written; levels of the output count again from here
    {"point": "<id of a tuning>"}                      begun at an operating point
    {"undone": {"at": .., "was": {..}, "now": {..}}}   the previous gains are restored
    {"given_back": ".."}                               released by a loop process, with its message for the next start

of a change of gains without a verification:

    {"gains": "unproved", "change": "..", "found": {..}}    a change of the ledger is pending, from the gains found
    {"gains": "proved"}                                the gains in the device are kept

Invariants:

1. A lease without `ended` was interrupted, or has left its loop as it is: the next start continues it.
2. A damaged entry is never used. A tuning whose found values are readable is restored to these, from anywhere within
   its envelope; any other lease with a damaged entry is unresolved.
3. A record of another version is damaged.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from autotuner.control.records.store import ENTRIES, LEASES, SAMPLES
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Sample
from autotuner.core.verdict import Outcome, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from autotuner.control.records.store import Store

VERSION = 2
"""Version of the record's form; a record of another one is not read."""
INTERRUPTED = "interrupted"
"""Code of the verdict of an interrupted run whose loop was restored later."""
PROVED, UNPROVED = "proved", "unproved"


class Kind(StrEnum):
    """Kinds of a lease."""

    TUNING = "tuning"
    VERIFICATION = "verification"
    SCHEDULE = "schedule"
    GAINS = "gains"


NAMES = {
    Kind.TUNING: "tuning",
    Kind.VERIFICATION: "verification",
    Kind.SCHEDULE: "run over operating points",
    Kind.GAINS: "change of gains",
}


@dataclass(frozen=True, slots=True)
class Before:
    """State in which the loop was found.

    Attributes
    ----------
    output : float
        Output, output units.
    auto : float or None
        1.0 when the device's own controller drove the output; None when the device has no such signal.
    set_point : float or None
        Its set point, PV units; None where nothing moves it.
    """

    output: float
    auto: float | None
    set_point: float | None = None


@dataclass(slots=True)
class LeaseRecord:
    """The content of a journal: of a tuning, a verification, a run over operating points, or a change of gains.

    Attributes
    ----------
    name : str
        Name of the lease in the store.
    tuning, loop, device, started_at : str
        Whose it is; `device` is the `device_key` of its loop then. Of a run over operating points, its identifier; of
        gains without a tuning, the change.
    request : mapping
        The request.
    before : Before or None
        How the loop was found; None while it cannot have been disturbed.
    kind : Kind
        What it is of.
    commanded : set of float
        The range of the outputs that were about to be written, output units; of a verification, in manual at its end.
    wide : bool
        Whether other outputs may have been written: any within the envelope of the loop.
    target : float or None
        The output at which it was to end, once that was decided: the one before, or the declared safe one.
    set_points : set of float
        The set point as it was found, and each that was about to be written, PV units.
    mode : float or None
        The mode that was about to be written last.
    proved : bool or None
        Whether the gains that it wrote are to stay; None where it writes none.
    change : str or None
        The pending change of the ledger, by its start time; None except for gains without a verification.
    found : mapping of str to float
        Number of each signal before that.
    points : list of str
        The tunings that a run over operating points began.
    undone : mapping or None
        Restore of the gains after the interruption: time, and the number of each signal before and now.
    left : Verdict or None
        Why it ended, where that was with a loop that could not be released; None where its program was killed.
    released : str or None
        How the loop was released after it was interrupted, where that is still to be reported.
    restored : bool
        Whether the loop had been released.
    verdict : Verdict or None
        How it ended; None when it was interrupted.
    samples : list of Sample
        The recording.
    """

    name: str
    tuning: str
    loop: str
    device: str
    started_at: str
    request: Mapping[str, Any]
    before: Before | None = None
    kind: Kind = Kind.TUNING
    commanded: set[float] = field(default_factory=set)
    wide: bool = False
    target: float | None = None
    set_points: set[float] = field(default_factory=set)
    mode: float | None = None
    proved: bool | None = None
    change: str | None = None
    found: Mapping[str, float] = field(default_factory=dict)
    points: list[str] = field(default_factory=list)
    undone: Mapping[str, Any] | None = None
    left: Verdict | None = None
    released: str | None = None
    restored: bool = False
    verdict: Verdict | None = None
    samples: list[Sample] = field(default_factory=list)

    @property
    def why(self) -> str:
        """Reason of the end."""
        return self.left.message if self.left else f"the program was killed during the {NAMES[self.kind]}"

    @property
    def after(self) -> str:
        """Kind of the run after which its loop is released, for messages."""
        return "at a later try" if self.left else "after a kill"

    @property
    def numbers(self) -> list[float]:
        """Every number that a recovery may write or compare with."""
        found_values = self.before
        found = [] if found_values is None else [found_values.auto, found_values.set_point]
        numbers = [*found, self.target, self.mode, *self.commanded, *self.set_points, *self.found.values()]
        return [
            *([] if found_values is None else [found_values.output]),
            *(value for value in numbers if value is not None),
        ]

    @property
    def settings(self) -> ExperimentSettings:
        """Settings of the experiment."""
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
                self.released, self.restored = what, True

    def _find(self, found_values: Before) -> None:
        self.before = found_values
        if found_values.set_point is None:
            self._aim(found_values.output)
        else:
            self.set_points.add(found_values.set_point)

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


class DamagedRecordError(ValueError):
    """The record of a lease cannot be trusted."""


def read_record(store: Store, name: str) -> LeaseRecord:
    """Return the record of a lease.

    Raises
    ------
    OSError
        The store cannot be read.
    DamagedRecordError
        The record is missing, damaged, of another version, or holds entries that no program writes.
    """
    heads, entries = store.rows(LEASES, name), store.rows(ENTRIES, name)
    if heads.damaged or len(heads.values) != 1:
        raise DamagedRecordError(f"the record of lease {name} is missing or damaged")
    try:
        kept = _kept(name, heads.values[0], entries.values)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedRecordError(f"the record of lease {name} is not understood: {error!r}") from error
    if entries.damaged:
        if kept.kind is not Kind.TUNING or kept.before is None:
            raise DamagedRecordError(f"an entry of lease {name} is damaged")
        kept.wide = True
    kept.samples = list(_samples(store.rows(SAMPLES, name).values))
    return kept


def _kept(name: str, head: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> LeaseRecord:
    if head.get("record") != VERSION:
        raise ValueError(f"it is of version {head.get('record')!r}, not {VERSION}")
    texts = {key: head[key] for key in ("tuning", "loop", "device", "started_at")}
    if not all(isinstance(text, str) for text in texts.values()):
        raise ValueError("a name is no text")
    kept = LeaseRecord(name, **texts, request=head["request"], kind=Kind(head.get("kind", Kind.TUNING)))
    for entry in entries:
        kept.take(entry)
    if not all(map(_is_finite, kept.numbers)):
        raise ValueError("a value is not finite")
    return kept


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _samples(rows: Sequence[object]) -> Iterator[Sample]:
    """Return the samples of rows; skip rows that are not valid."""
    for samples in rows:
        with contextlib.suppress(TypeError, ValueError):
            for values in samples if isinstance(samples, list) else []:
                yield Sample(*(math.nan if value is None else float(value) for value in values))
