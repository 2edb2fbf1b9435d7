"""An experiment as an operation: its controller is published in reports after each sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.driving.controller import Controller
from autotuner.control.operations.messages import Closing, ExperimentState, Report
from autotuner.control.records.lease_record import Kind
from autotuner.control.reporting.events import SampleTaken
from autotuner.ports import Carried

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.control.operations.messages import Inform
    from autotuner.control.operations.operation import Station
    from autotuner.control.reporting.events import Event
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

GATHERED_S = 0.05
"""Longest time for which samples gather, s; anything else is published at once."""


class Reporter:
    """Publishes the state of a controller.

    Parameters
    ----------
    deliver : callable
        Takes reports.
    """

    def __init__(self, deliver: Callable[[Report], None]) -> None:
        self.controller: Controller | None = None
        self._deliver = deliver
        self._events: list[Event] = []
        self._outputs: list[tuple[int, float]] = []
        self._published: ExperimentState | None = None
        self._sent_s = 0.0

    def take(self, event: Event) -> None:
        """Take an event, and publish it now or with those that follow."""
        self._events.append(event)
        if not isinstance(event, SampleTaken):
            self.flush()
            return
        self._outputs.append((len(self._samples) - 1, event.output))
        if event.t - self._sent_s >= GATHERED_S:
            self._sent_s = event.t
            self._send(None)

    def flush(self) -> None:
        """Publish changes."""
        self._send(self._news())

    def _send(self, state: ExperimentState | None) -> None:
        events, self._events = self._events, []
        before = self.controller.before if self.controller else None
        self._deliver(Report(events, self._corrected(), before, state))

    def _corrected(self) -> list[tuple[int, Sample]]:
        """Return the samples whose output differs from the published one after a read-back."""
        samples = self._samples
        corrected = [(k, samples[k]) for k, output in self._outputs if samples[k].output != output]
        self._outputs = self._outputs[-1:]  # that one may still be corrected
        return corrected

    @property
    def _samples(self) -> list[Sample]:
        return self.controller.samples if self.controller else []

    def _news(self) -> ExperimentState | None:
        experiment = self.controller.experiment if self.controller else None
        if experiment is None:
            return None
        state = ExperimentState(tuple(experiment.warnings), experiment.settings_so_far())
        if state == self._published:
            return None
        self._published = state
        return state


@dataclass(frozen=True, slots=True)
class Experiment:
    """An experiment is conducted with these settings."""

    settings: ExperimentSettings

    kind = Kind.TUNING

    def begin(self, station: Station) -> Conducting:
        """Return the operation."""
        return Conducting(self.settings, station)


class Conducting:
    """A running experiment; publishes `autotuner.control.operations.messages.Report`."""

    def __init__(self, settings: ExperimentSettings, station: Station) -> None:
        self._station, self._reporter = station, Reporter(station.publish)
        journal, reporter = station.journal, self._reporter

        def publish(event: Event) -> None:
            if journal is not None:
                journal.note(event)
            reporter.take(event)

        self.controller = reporter.controller = Controller(station.backend, settings, station.loop, publish, journal)

    def abort(self, verdict: Verdict) -> None:
        """Request the end."""
        self.controller.abort(verdict)

    def flush(self) -> None:
        """Publish changes besides events."""
        self._reporter.flush()

    def inform(self, message: Inform) -> None:
        """Pass a model to the experiment."""
        if self.controller.experiment is not None:
            self.controller.experiment.inform(
                message.relative_error, message.expected_loss, integrating=message.integrating
            )

    async def run(self) -> Closing:
        """Conduct it to its end."""
        verdict = await self.controller.run()
        self.flush()
        backend = self._station.backend
        carried = backend.carried() if isinstance(backend, Carried) else None
        return Closing(verdict, self.controller.restored, carried)
