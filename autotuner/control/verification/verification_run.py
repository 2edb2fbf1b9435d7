"""State of a verification: subject, prediction, measurement, verdict."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.control.clock.ticker import utc_now
from autotuner.control.verification.verification_events import (
    GainsWritten,
    StepMade,
    VerificationEnded,
    VerificationPhase,
    VerificationPhaseChanged,
)
from autotuner.core.verdict import Outcome

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from autotuner.control.gains.apply import Applied, RolledBack
    from autotuner.control.verification.verification_events import VerificationEvent
    from autotuner.core.design import PidSettings, Scenario
    from autotuner.core.design.simulation.actuators import Named
    from autotuner.core.design.simulation.verification import Band, Range, Rest
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

TIMES_TO_SETTLE = 3.0
"""Dead and integral times after which the first move of a controller has died away."""
SHOWN = 300
"""Most points of a response in a result."""


@dataclass(frozen=True, slots=True)
class Claim:
    """Subject of a verification: the controller in the device, and the process of its design.

    Attributes
    ----------
    model : ProcessModel
        The process.
    covariance : array of float or None
        Covariance of its parameters.
    settings : PidSettings
        The controller as the device runs it.
    step : float or None
        Step of the set point that is wanted, PV units.
    scan_s : float
        How often the device's controller runs, s: so much later than known it may act.
    effects : tuple of Named
        Effects that a diagnosis has found in addition to the process.
    """

    model: ProcessModel
    covariance: FloatArray | None
    settings: PidSettings
    step: float | None = None
    scan_s: float = 0.0
    effects: tuple[Named, ...] = ()

    @property
    def settling_s(self) -> float:
        """Time without a judgement after the take-over by the controller, s."""
        Ti = self.settings.gains.Ti
        return TIMES_TO_SETTLE * (self.model.D + (Ti if math.isfinite(Ti) else 0.0))


@dataclass(frozen=True, slots=True)
class GainsUnderTest:
    """The gains of a verification, as numbers of the device by signal: before, as written, and as read back."""

    form: str
    before: Mapping[str, float]
    written: Mapping[str, float]
    read_back: Mapping[str, float]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        numbers = {name: dict(getattr(self, name)) for name in ("before", "written", "read_back")}
        return {"form": self.form, **numbers}


@dataclass(slots=True)
class VerificationRun:
    """State of a verification.

    Attributes
    ----------
    actor : str
        Who requested it: the name of a token, `local`, or a user of the shell.
    started_at, ended_at : str
        When, ISO 8601 in UTC; `ended_at` is empty while it runs.
    phase : VerificationPhase
        Where it is.
    gains : GainsUnderTest or None
        Written gains, and the previous gains of the device.
    events : list of VerificationEvent
        What happened, in order.
    verdict : Verdict or None
        Verdict: `done` passed; `refused` with the code `verification_failed` is the decision of the judge.
    rolled_back : bool
        Whether the old gains are restored because of it.
    scenario : Scenario or None
        The step that was made.
    band : Band or None
        What was predicted, deviations from rest.
    rest : Rest or None
        The loop before the step.
    samples : list of Sample
        The response; times from the step.
    unresolved : Verdict or None
        Why it ended, where something could not be restored; not part of the result, because the verdict has it.
    applied : Applied or None
        Gains of it that the device holds.
    back : RolledBack or None
        Restore of the previous gains.
    publisher : Teller or None
        Sends changes to a mirror of this run.
    """

    actor: str = "local"
    started_at: str = field(default_factory=utc_now)
    ended_at: str = ""
    phase: VerificationPhase = VerificationPhase.WRITE
    gains: GainsUnderTest | None = None
    verdict: Verdict | None = None
    rolled_back: bool = False
    scenario: Scenario | None = None
    band: Band | None = None
    rest: Rest | None = None
    samples: list[Sample] = field(default_factory=list)
    unresolved: Verdict | None = None
    applied: Applied | None = None
    back: RolledBack | None = None
    publisher: RunPublisher | None = field(default=None, repr=False)
    events: list[VerificationEvent] = field(default_factory=list, repr=False)
    _news: asyncio.Event = field(default_factory=asyncio.Event, repr=False)

    @property
    def end_published(self) -> bool:
        """Whether the event that ends it is among the events."""
        return bool(self.events) and isinstance(self.events[-1], VerificationEnded)

    @property
    def passed(self) -> bool:
        """Whether the loop matched the prediction."""
        return self.verdict is not None and self.verdict.outcome is Outcome.DONE

    @property
    def overshoot(self) -> float | None:
        """Measured overshoot, share of the step; a mean of three samples, to exclude single noisy samples."""
        if self.scenario is None or self.rest is None or len(self.samples) < 3 or not self.scenario.set_point_step:
            return None
        share = (np.array([s.pv for s in self.samples]) - self.rest.pv) / self.scenario.set_point_step
        return max(0.0, float(np.max(np.convolve(share, np.full(3, 1.0 / 3.0), "valid"))) - 1.0)

    def publish(self, event: VerificationEvent) -> None:
        """Take an event and wake the readers."""
        self.events.append(event)
        self._news.set()
        self._news = asyncio.Event()
        if self.publisher is not None:
            self.publisher.flush()

    def take(self, progress: Progress) -> None:
        """Take the news of the run of which this is the mirror."""
        for name, value in progress.values.items():
            setattr(self, name, value)
        self.samples.extend(progress.samples)
        for event in progress.events:
            self.publish(event)

    def enter(self, phase: VerificationPhase, t: float, expected_s: float = math.nan) -> None:
        """Enter a phase at `t` s from the start; it is published."""
        self.phase = phase
        self.publish(VerificationPhaseChanged(t, phase.value, expected_s))

    def take_gains(self, gains: GainsUnderTest) -> None:
        """Record and publish the gains under test."""
        self.gains = gains
        numbers = (dict(gains.before), dict(gains.written), dict(gains.read_back))
        self.publish(GainsWritten(0.0, gains.form, *numbers))

    def take_step(self, t: float, set_point: float) -> None:
        """Record the step at `t` s from the start; publish it with the band."""
        assert self.scenario is not None  # noqa: S101 - planned before it is made
        assert self.rest is not None  # noqa: S101
        step, duration_s = self.scenario.set_point_step, self.scenario.duration_s
        bands = self._predicted(), self._predicted_output()
        self.publish(StepMade(t, step, set_point, duration_s, self.rest.pv, self.rest.output, *bands))

    def end(self, verdict: Verdict, t: float) -> None:
        """Make the verdict known."""
        self.phase, self.ended_at, self.verdict = VerificationPhase.ENDED, utc_now(), verdict
        words = verdict.outcome.value, verdict.code, verdict.message, verdict.remedy
        self.publish(VerificationEnded(t, *words, self.passed, self.rolled_back))

    async def more(self, seen: int) -> None:
        """Return when there are more than `seen` events."""
        if len(self.events) <= seen:
            await self._news.wait()

    async def follow(self) -> AsyncIterator[VerificationEvent]:
        """Yield every event from the first, then each new one as it happens, until the verification has ended."""
        seen = 0
        while not (self.end_published and seen >= len(self.events)):
            for event in self.events[seen:]:
                yield event
                seen += 1
            if not self.end_published:
                await self.more(seen)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; of a long response some points only."""
        every = slice(None, None, max(1, len(self.samples) // SHOWN))
        rest = self.rest
        return {
            "state": "running" if self.verdict is None else "ended",
            "phase": self.phase.value,
            "actor": self.actor,
            "started_at": self.started_at,
            "ended_at": self.ended_at or None,
            "gains": self.gains.to_dict() if self.gains else None,
            "passed": self.passed if self.verdict else None,
            "rolled_back": self.rolled_back,
            "verdict": self.verdict.to_dict() if self.verdict else None,
            "step": self.scenario.set_point_step if self.scenario else None,
            "duration_s": self.scenario.duration_s if self.scenario else None,
            "rest": {"pv": rest.pv, "output": rest.output, "noise_sigma": rest.noise_sigma} if rest else None,
            "overshoot": self.overshoot,
            "predicted_overshoot": self.band.nominal.overshoot if self.band else None,
            "response": [[s.t, s.pv, s.output] for s in self.samples[every]],
            "predicted": self._predicted(),
            "predicted_output": self._predicted_output(),
        }

    def _predicted(self) -> list[list[float]]:
        return [] if self.band is None or self.rest is None else _rows(self.band.t, self.band.pv, self.rest.pv)

    def _predicted_output(self) -> list[list[float]]:
        return [] if self.band is None or self.rest is None else _rows(self.band.t, self.band.output, self.rest.output)


MIRRORED = (
    "phase",
    "gains",
    "verdict",
    "ended_at",
    "rolled_back",
    "scenario",
    "band",
    "rest",
    "unresolved",
    "applied",
    "back",
)
"""Attributes of a run that its mirror takes over."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Changes of a run: attributes that were set, samples, events."""

    values: Mapping[str, object]
    samples: list[Sample]
    events: list[VerificationEvent]


class RunPublisher:
    """Sends the changes of a run, with each event."""

    def __init__(self, run: VerificationRun, send: Callable[[Progress], None]) -> None:
        self._run, self._send = run, send
        self._sent: dict[str, object] = {}
        self._samples = self._events = 0

    def flush(self) -> None:
        """Send the changes since the last call."""
        run, sent = self._run, self._sent
        values = {name: getattr(run, name) for name in MIRRORED}
        new = {name: value for name, value in values.items() if name not in sent or value is not sent[name]}
        self._sent |= new
        self._send(Progress(new, run.samples[self._samples :], run.events[self._events :]))
        self._samples, self._events = len(run.samples), len(run.events)


def _rows(t: FloatArray, limits: Range, rest: float) -> list[list[float]]:
    """Return rows of time, lowest and highest value, decimated for a picture."""
    every = slice(None, None, max(1, t.size // SHOWN))
    low, high = limits.low[every] + rest, limits.high[every] + rest
    return [list(row) for row in zip(t[every].tolist(), low.tolist(), high.tolist(), strict=True)]
