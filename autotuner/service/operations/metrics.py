"""Metrics in the text format of Prometheus.

Invariants:

1. Events are counted when the metrics are requested, from the last counted one: no loop spends
   time on them.
2. A present state (an output unknown) is the last one reported: tunings are processed in the order of their starts.
3. Labels are names of loops, phases, outcomes and codes: their number is bounded by the configuration.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)

from autotuner.control.reporting.events import (
    Ended,
    LinkTrouble,
    OutputRestored,
    OutputUnknown,
    PhaseChanged,
    SampleTaken,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner.application.tuning_run import TuningRun
    from autotuner.control.reporting.events import Event
    from autotuner.control.verification.verification_run import VerificationRun

LATENESS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)
"""Upper ends of the classes of lateness, s."""


disable_created_metrics()  # type: ignore[no-untyped-call]  # a series beside each counter that is never requested


class Metrics:
    """The counters of one service."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._counted: dict[str, tuple[list[Event], int]] = {}
        ProcessCollector(registry=self._registry)
        entry = self._gauge("autotuner_build_info", "The version that runs", "version")
        entry.labels(version("relay-autotuner")).set(1.0)
        self._samples = self._counter("autotuner_samples", "Samples taken", "loop")
        self._lateness = Histogram(
            "autotuner_sample_lateness_seconds",
            "Lateness of samples",
            ["loop"],
            buckets=LATENESS_S,
            registry=self._registry,
        )
        self._link_errors = self._counter("autotuner_link_errors", "Reads and writes that failed", "loop")
        self._phases = self._counter("autotuner_phases", "Phases entered", "loop", "phase")
        self._ended = self._counter("autotuner_tunings", "Tunings that ended", "loop", "outcome", "code")
        self._verified = self._counter("autotuner_verifications", "Verifications that ended", "loop", "outcome", "code")
        self._runs: dict[str, VerificationRun] = {}
        self._unknown = self._gauge("autotuner_output_unknown", "Whether an output could not be restored", "loop")
        self._running = self._gauge("autotuner_tuning_running", "Whether a tuning holds the loop", "loop")
        self._link = self._gauge("autotuner_link_up", "Whether the device answered at its last poll", "loop")
        self._store = self._gauge("autotuner_store_up", "Whether the archive can be written")

    def count(self, tunings: Iterable[TuningRun]) -> None:
        """Count the events of tunings since the last call, the oldest first."""
        counted = {}
        for tuning in tunings:
            events = tuning.events
            before = len(tuning.kept.samples) if tuning.kept else 0  # of an earlier run: they were counted there
            seen, first = self._counted.get(tuning.id, (events, before))
            if seen is not events:  # the same tuning taken over again, to release its loop
                first = before
            counted[tuning.id] = events, len(events)
            for event in events[first : counted[tuning.id][1]]:
                self._take(tuning.loop, event, again=tuning.ended_before)
            self._take_verification(tuning)
        self._counted = counted
        self._runs = {key: run for key, run in self._runs.items() if key in counted}

    def show(self, links: Iterable[tuple[str, bool, bool | None]], *, store: bool) -> None:
        """Set the gauges: for each loop whether it is being tuned and whether its device answers, and the store."""
        for loop, running, link in links:
            self._samples.labels(loop)  # a loop that has not been tuned yet has counts of zero
            self._link_errors.labels(loop)
            self._unknown.labels(loop)
            self._running.labels(loop).set(running)
            self._link.labels(loop).set(float("nan") if link is None else link)
        self._store.set(store)

    def show_unknown(self, loops: Iterable[str]) -> None:
        """Set the loops whose output is unknown because the record of an interrupted lease cannot be used."""
        for loop in loops:
            self._unknown.labels(loop).set(1.0)

    def text(self) -> bytes:
        """Return all numbers."""
        return generate_latest(self._registry)

    def _take_verification(self, tuning: TuningRun) -> None:
        run = tuning.verification
        if run is None or (verdict := run.verdict) is None or self._runs.get(tuning.id) is run:
            return
        self._runs[tuning.id] = run
        self._verified.labels(tuning.loop, verdict.outcome, verdict.code).inc()
        self._unknown.labels(tuning.loop).set(verdict.code == "output_unknown")

    def _take(self, loop: str, event: Event, *, again: bool) -> None:
        """Take an event; the end of a tuning that had ended before, `again`, was counted by the earlier run."""
        match event:
            case SampleTaken(lateness_s=lateness_s):
                self._samples.labels(loop).inc()
                self._lateness.labels(loop).observe(lateness_s)
            case LinkTrouble():
                self._link_errors.labels(loop).inc()
            case PhaseChanged(phase=phase):
                self._phases.labels(loop, phase).inc()
            case OutputUnknown():
                self._unknown.labels(loop).set(1.0)
            case OutputRestored():
                self._unknown.labels(loop).set(0.0)
            case Ended(outcome=outcome, code=code):
                if not again:
                    self._ended.labels(loop, outcome, code).inc()
                self._unknown.labels(loop).set(code == "output_unknown")

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(name, text, labels, registry=self._registry)

    def _gauge(self, name: str, text: str, *labels: str) -> Gauge:
        return Gauge(name, text, labels, registry=self._registry)
