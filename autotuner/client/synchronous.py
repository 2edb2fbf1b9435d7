"""The synchronous client, which `autotuner.client.generate` makes of `asynchronous`: edit that one."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any, TypeVar

import httpx

from autotuner.client import calls
from autotuner.client.errors import check
from autotuner.client.stream import Lines

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from types import TracebackType
    from typing import Self, Unpack

    from autotuner.client import requests
    from autotuner.service.schemas import monitoring, operation, resources, views
    from autotuner.service.schemas.diagnosis import Diagnosis, DiagnosisCurves

T = TypeVar("T")


class Client:
    """A service at an address.

    Parameters
    ----------
    url : str
        Such as ``http://127.0.0.1:8321``.
    token : str, optional
        The bearer token, where the service requires one.
    timeout_s : float
        Longest wait for an answer, s.
    http : httpx.Client, optional
        What sends; made by default, and closed here only then.

    Every method raises `ServiceError` when the service refuses or fails, and `httpx.TransportError` when it cannot be
    reached.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        *,
        timeout_s: float = calls.TIMEOUT_S,
        http: httpx.Client | None = None,
    ) -> None:
        self._own = http is None
        self._http = http or httpx.Client(timeout=timeout_s)
        self._http.base_url = httpx.URL(url)
        if token is not None:
            self._http.headers["authorization"] = f"Bearer {token}"

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        if self._own:
            self._http.close()

    def healthz(self) -> operation.Health:
        """Ask whether the process answers."""
        return self._do(calls.healthz())

    def readyz(self, loop: str | None = None) -> operation.Readiness:
        """Ask whether tunings can be started and kept, and for each loop's link; of one loop, it must be up."""
        return self._do(calls.readyz(loop))

    def get_metrics(self) -> str:
        """Return the counters, in the text format of Prometheus."""
        return self._do(calls.get_metrics())

    def list_audit(
        self,
        limit: int | None = None,
        before: int | None = None,
        *,
        loop: str | None = None,
        actor: str | None = None,
    ) -> operation.Audit:
        """Return the audit, the newest entry first; `before` continues after the entry of that number."""
        return self._do(calls.list_audit(limit, before, loop, actor))

    def reload_configuration(self) -> operation.Reloaded:
        """Have the configuration file read again; a running tuning is never touched."""
        return self._do(calls.reload_configuration())

    def list_problem_types(self) -> list[operation.ProblemType]:
        """List the kinds of problems that the service reports."""
        return self._do(calls.list_problem_types())

    def list_loops(self) -> resources.Loops:
        """List the configured loops."""
        return self._do(calls.list_loops())

    def get_loop(self, loop: str) -> resources.Loop:
        """Return one loop."""
        return self._do(calls.get_loop(loop))

    def list_readings(self, loop: str | None = None) -> resources.Readings:
        """Return the readings of the loops; an idle one is read for the next call."""
        return self._do(calls.list_readings(loop))

    def start_monitor(self, loop: str, **how: Unpack[requests.MonitorStart]) -> monitoring.Monitoring:
        """Monitor a loop in normal operation against the results of its tuning; nothing is written."""
        return self._do(calls.start_monitor(loop, how))

    def get_monitor(self, loop: str) -> monitoring.Monitoring:
        """Return the result of monitoring a loop."""
        return self._do(calls.get_monitor(loop))

    def end_monitor(self, loop: str) -> monitoring.Monitoring:
        """Watch a loop no more."""
        return self._do(calls.end_monitor(loop))

    def get_device_gains(self, loop: str) -> resources.LoopGains:
        """Read the gains that the device of a loop holds now."""
        return self._do(calls.get_device_gains(loop))

    def plan_tuning(self, loop: str, output: float | None = None, **how: Unpack[requests.TuningStart]) -> views.Plan:
        """Return the plan of a tuning; nothing is moved. `output` is the present output, where known."""
        return self._do(calls.plan_tuning(loop, output, how))

    def start_tuning(self, loop: str, key: str | None = None, **how: Unpack[requests.TuningStart]) -> resources.Tuning:
        """Start a tuning; sent again with the same key (8 letters at least) it starts no other."""
        return self._do(calls.start_tuning(loop, key, how))

    def list_tunings(self, loop: str | None = None, limit: int | None = None) -> resources.Tunings:
        """List the tunings, the newest first."""
        return self._do(calls.list_tunings(loop, limit))

    def get_tuning(self, tuning_id: str) -> resources.Tuning:
        """Return the present state of a tuning."""
        return self._do(calls.get_tuning(tuning_id))

    def abort_tuning(self, tuning_id: str) -> resources.Tuning:
        """End a running tuning: its output is restored at once."""
        return self._do(calls.abort_tuning(tuning_id))

    def get_recording(self, tuning_id: str) -> str:
        """Return the recording so far, as CSV text for `Recording.from_csv_text`."""
        return self._do(calls.get_recording(tuning_id))

    def get_report(self, tuning_id: str) -> str:
        """Return the report of a tuning, as HTML."""
        return self._do(calls.get_report(tuning_id))

    def export_tuning(self, tuning_id: str) -> str:
        """Return a tuning as one file, for `autotuner replay`."""
        return self._do(calls.export_tuning(tuning_id))

    def get_curves(self, tuning_id: str, most: int | None = None) -> views.Curves:
        """Return measured and simulated PV and the residual, with at most `most` points."""
        return self._do(calls.get_curves(tuning_id, most))

    def get_before_and_after(self, tuning_id: str, most: int | None = None) -> DiagnosisCurves:
        """Return measured PV and the simulated one without and with the effects that the diagnosis names."""
        return self._do(calls.get_before_and_after(tuning_id, most))

    def get_choices(self, tuning_id: str) -> views.Choices:
        """Return the gains of every goal side by side."""
        return self._do(calls.get_choices(tuning_id))

    def compute_gains(self, tuning_id: str, **which: Unpack[requests.GainsChoice]) -> resources.Gains:
        """Compute other gains from the identified model; the loop is not touched."""
        return self._do(calls.compute_gains(tuning_id, which))

    def apply_gains(self, tuning_id: str, **which: Unpack[requests.GainsToApply]) -> resources.Applied:
        """Write gains to the device and read them back; the old ones are kept."""
        return self._do(calls.apply_gains(tuning_id, which))

    def verify_gains(self, tuning_id: str, step: float | None = None) -> resources.VerificationResult:
        """Make a small set-point step under the gains that were applied; answered at its end."""
        return self._do(calls.verify_gains(tuning_id, step))

    def roll_back(self, tuning_id: str, *, force: bool = False) -> resources.RolledBack:
        """Restore the gains that the device had before; `force`: also over gains that were set by others since."""
        return self._do(calls.roll_back(tuning_id, force=force))

    def start_schedule(self, loop: str, **how: Unpack[requests.ScheduleStart]) -> resources.ScheduleRun:
        """Tune at several set points, one after the other."""
        return self._do(calls.start_schedule(loop, how))

    def get_schedule(self, schedule_id: str) -> resources.ScheduleRun:
        """Return a run over operating points, and its gain schedule."""
        return self._do(calls.get_schedule(schedule_id))

    def abort_schedule(self, schedule_id: str) -> resources.ScheduleRun:
        """End a run over operating points; output and set point go back."""
        return self._do(calls.abort_schedule(schedule_id))

    def combine_tunings(self, **how: Unpack[requests.TuningsToCombine]) -> resources.Schedule:
        """Make a schedule of the gains of several tunings."""
        return self._do(calls.combine_tunings(how))

    def identify(self, csv: bytes, **how: Unpack[requests.IdentificationChoice]) -> views.Identification:
        """Identify a process from a recording in CSV (UTF-8)."""
        return self._do(calls.identify(csv, how))

    def diagnose(self, csv: bytes, **how: Unpack[requests.DiagnosisChoice]) -> Diagnosis:
        """Diagnose a recording in CSV (UTF-8): effects that it shows and a model lacks."""
        return self._do(calls.diagnose(csv, how))

    def follow_tuning(self, tuning_id: str, last: int = -1) -> Iterator[dict[str, Any]]:
        """Yield every event after the one of index `last`, from the first by default, until the tuning has ended.

        A broken connection is resumed where it was; `StreamError` when that does not help.
        """
        with closing(self._followed(calls.follow_tuning, tuning_id, last)) as events:
            yield from events

    def follow_verification(self, tuning_id: str, last: int = -1) -> Iterator[dict[str, Any]]:
        """Yield every event of the latest verification of a tuning, as `follow_tuning` does those of the tuning."""
        with closing(self._followed(calls.follow_verification, tuning_id, last)) as events:
            yield from events

    def _followed(
        self, call: Callable[[str, int], calls.Call[None]], tuning_id: str, last: int
    ) -> Generator[dict[str, Any], None, None]:
        """Yield the events of a stream until its last one."""
        lines = Lines(last)
        while not lines.ended:
            reason: Exception | None = None
            try:
                with closing(self._stream(call(tuning_id, lines.last), lines)) as events:
                    yield from events
            except httpx.TransportError as error:
                reason = error
            if not lines.ended:
                lines.broken(reason)

    def _stream(self, call: calls.Call[None], lines: Lines) -> Generator[dict[str, Any], None, None]:
        """Yield the events of one connection."""
        with self._http.stream(**call.request()) as response:
            if response.is_error:
                response.read()
            check(response)
            lines.ended = response.status_code == httpx.codes.NO_CONTENT
            for line in response.iter_lines():
                if (event := lines.take(line)) is not None:
                    yield event

    def wait(self, tuning_id: str) -> resources.Tuning:
        """Return a tuning when it has ended."""
        for _ in self.follow_tuning(tuning_id):
            pass
        return self.get_tuning(tuning_id)

    def tune(self, loop: str, key: str | None = None, **how: Unpack[requests.TuningStart]) -> resources.Tuning:
        """Start a tuning, and return it when it has ended."""
        started = self.start_tuning(loop, key, **how)
        return self.wait(started.id)

    def _do(self, call: calls.Call[T]) -> T:
        return call.answer(self._http.request(**call.request()))
