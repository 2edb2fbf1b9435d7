"""The asynchronous client: a method a call of `autotuner.client.calls`, and following a tuning to its end."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING, Any, TypeVar

import httpx

from autotuner.client import calls
from autotuner.client.errors import check
from autotuner.client.stream import Lines

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable
    from types import TracebackType
    from typing import Self, Unpack

    from autotuner.client import requests
    from autotuner.service.schemas import monitoring, operation, resources, views
    from autotuner.service.schemas.diagnosis import Diagnosis, DiagnosisCurves

T = TypeVar("T")


class AsyncClient:
    """A service at an address.

    Parameters
    ----------
    url : str
        Such as ``http://127.0.0.1:8321``.
    token : str, optional
        The bearer token, where the service requires one.
    timeout_s : float
        Longest wait for an answer, s.
    http : httpx.AsyncClient, optional
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
        http: httpx.AsyncClient | None = None,
    ) -> None:
        self._own = http is None
        self._http = http or httpx.AsyncClient(timeout=timeout_s)
        self._http.base_url = httpx.URL(url)
        if token is not None:
            self._http.headers["authorization"] = f"Bearer {token}"

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        if self._own:
            await self._http.aclose()

    async def healthz(self) -> operation.Health:
        """Ask whether the process answers."""
        return await self._do(calls.healthz())

    async def readyz(self, loop: str | None = None) -> operation.Readiness:
        """Ask whether tunings can be started and kept, and for each loop's link; of one loop, it must be up."""
        return await self._do(calls.readyz(loop))

    async def get_metrics(self) -> str:
        """Return the counters, in the text format of Prometheus."""
        return await self._do(calls.get_metrics())

    async def list_audit(
        self,
        limit: int | None = None,
        before: int | None = None,
        *,
        loop: str | None = None,
        actor: str | None = None,
    ) -> operation.Audit:
        """Return the audit, the newest entry first; `before` continues after the entry of that number."""
        return await self._do(calls.list_audit(limit, before, loop, actor))

    async def reload_configuration(self) -> operation.Reloaded:
        """Have the configuration file read again; a running tuning is never touched."""
        return await self._do(calls.reload_configuration())

    async def list_problem_types(self) -> list[operation.ProblemType]:
        """List the kinds of problems that the service reports."""
        return await self._do(calls.list_problem_types())

    async def list_loops(self) -> resources.Loops:
        """List the configured loops."""
        return await self._do(calls.list_loops())

    async def get_loop(self, loop: str) -> resources.Loop:
        """Return one loop."""
        return await self._do(calls.get_loop(loop))

    async def list_readings(self, loop: str | None = None) -> resources.Readings:
        """Return the readings of the loops; an idle one is read for the next call."""
        return await self._do(calls.list_readings(loop))

    async def start_monitor(self, loop: str, **how: Unpack[requests.MonitorStart]) -> monitoring.Monitoring:
        """Monitor a loop in normal operation against the results of its tuning; nothing is written."""
        return await self._do(calls.start_monitor(loop, how))

    async def get_monitor(self, loop: str) -> monitoring.Monitoring:
        """Return the result of monitoring a loop."""
        return await self._do(calls.get_monitor(loop))

    async def end_monitor(self, loop: str) -> monitoring.Monitoring:
        """Watch a loop no more."""
        return await self._do(calls.end_monitor(loop))

    async def get_device_gains(self, loop: str) -> resources.LoopGains:
        """Read the gains that the device of a loop holds now."""
        return await self._do(calls.get_device_gains(loop))

    async def plan_tuning(
        self, loop: str, output: float | None = None, **how: Unpack[requests.TuningStart]
    ) -> views.Plan:
        """Return the plan of a tuning; nothing is moved. `output` is the present output, where known."""
        return await self._do(calls.plan_tuning(loop, output, how))

    async def start_tuning(
        self, loop: str, key: str | None = None, **how: Unpack[requests.TuningStart]
    ) -> resources.Tuning:
        """Start a tuning; sent again with the same key (8 letters at least) it starts no other."""
        return await self._do(calls.start_tuning(loop, key, how))

    async def list_tunings(self, loop: str | None = None, limit: int | None = None) -> resources.Tunings:
        """List the tunings, the newest first."""
        return await self._do(calls.list_tunings(loop, limit))

    async def get_tuning(self, tuning_id: str) -> resources.Tuning:
        """Return the present state of a tuning."""
        return await self._do(calls.get_tuning(tuning_id))

    async def abort_tuning(self, tuning_id: str) -> resources.Tuning:
        """End a running tuning: its output is restored at once."""
        return await self._do(calls.abort_tuning(tuning_id))

    async def get_recording(self, tuning_id: str) -> str:
        """Return the recording so far, as CSV text for `Recording.from_csv_text`."""
        return await self._do(calls.get_recording(tuning_id))

    async def get_report(self, tuning_id: str) -> str:
        """Return the report of a tuning, as HTML."""
        return await self._do(calls.get_report(tuning_id))

    async def export_tuning(self, tuning_id: str) -> str:
        """Return a tuning as one file, for `autotuner replay`."""
        return await self._do(calls.export_tuning(tuning_id))

    async def get_curves(self, tuning_id: str, most: int | None = None) -> views.Curves:
        """Return measured and simulated PV and the residual, with at most `most` points."""
        return await self._do(calls.get_curves(tuning_id, most))

    async def get_before_and_after(self, tuning_id: str, most: int | None = None) -> DiagnosisCurves:
        """Return measured PV and the simulated one without and with the effects that the diagnosis names."""
        return await self._do(calls.get_before_and_after(tuning_id, most))

    async def get_choices(self, tuning_id: str) -> views.Choices:
        """Return the gains of every goal side by side."""
        return await self._do(calls.get_choices(tuning_id))

    async def compute_gains(self, tuning_id: str, **which: Unpack[requests.GainsChoice]) -> resources.Gains:
        """Compute other gains from the identified model; the loop is not touched."""
        return await self._do(calls.compute_gains(tuning_id, which))

    async def apply_gains(self, tuning_id: str, **which: Unpack[requests.GainsToApply]) -> resources.Applied:
        """Write gains to the device and read them back; the old ones are kept."""
        return await self._do(calls.apply_gains(tuning_id, which))

    async def verify_gains(self, tuning_id: str, step: float | None = None) -> resources.VerificationResult:
        """Make a small set-point step under the gains that were applied; answered at its end."""
        return await self._do(calls.verify_gains(tuning_id, step))

    async def roll_back(self, tuning_id: str, *, force: bool = False) -> resources.RolledBack:
        """Restore the gains that the device had before; `force`: also over gains that were set by others since."""
        return await self._do(calls.roll_back(tuning_id, force=force))

    async def start_schedule(self, loop: str, **how: Unpack[requests.ScheduleStart]) -> resources.ScheduleRun:
        """Tune at several set points, one after the other."""
        return await self._do(calls.start_schedule(loop, how))

    async def get_schedule(self, schedule_id: str) -> resources.ScheduleRun:
        """Return a run over operating points, and its gain schedule."""
        return await self._do(calls.get_schedule(schedule_id))

    async def abort_schedule(self, schedule_id: str) -> resources.ScheduleRun:
        """End a run over operating points; output and set point go back."""
        return await self._do(calls.abort_schedule(schedule_id))

    async def combine_tunings(self, **how: Unpack[requests.TuningsToCombine]) -> resources.Schedule:
        """Make a schedule of the gains of several tunings."""
        return await self._do(calls.combine_tunings(how))

    async def identify(self, csv: bytes, **how: Unpack[requests.IdentificationChoice]) -> views.Identification:
        """Identify a process from a recording in CSV (UTF-8)."""
        return await self._do(calls.identify(csv, how))

    async def diagnose(self, csv: bytes, **how: Unpack[requests.DiagnosisChoice]) -> Diagnosis:
        """Diagnose a recording in CSV (UTF-8): effects that it shows and a model lacks."""
        return await self._do(calls.diagnose(csv, how))

    async def follow_tuning(self, tuning_id: str, last: int = -1) -> AsyncIterator[dict[str, Any]]:
        """Yield every event after the one of index `last`, from the first by default, until the tuning has ended.

        A broken connection is resumed where it was; `StreamError` when that does not help.
        """
        async with aclosing(self._followed(calls.follow_tuning, tuning_id, last)) as events:
            async for event in events:
                yield event

    async def follow_verification(self, tuning_id: str, last: int = -1) -> AsyncIterator[dict[str, Any]]:
        """Yield every event of the latest verification of a tuning, as `follow_tuning` does those of the tuning."""
        async with aclosing(self._followed(calls.follow_verification, tuning_id, last)) as events:
            async for event in events:
                yield event

    async def _followed(
        self, call: Callable[[str, int], calls.Call[None]], tuning_id: str, last: int
    ) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the events of a stream until its last one."""
        lines = Lines(last)
        while not lines.ended:
            reason: Exception | None = None
            try:
                async with aclosing(self._stream(call(tuning_id, lines.last), lines)) as events:
                    async for event in events:
                        yield event
            except httpx.TransportError as error:
                reason = error
            if not lines.ended:
                lines.broken(reason)

    async def _stream(self, call: calls.Call[None], lines: Lines) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the events of one connection."""
        async with self._http.stream(**call.request()) as response:
            if response.is_error:
                await response.aread()
            check(response)
            lines.ended = response.status_code == httpx.codes.NO_CONTENT
            async for line in response.aiter_lines():
                if (event := lines.take(line)) is not None:
                    yield event

    async def wait(self, tuning_id: str) -> resources.Tuning:
        """Return a tuning when it has ended."""
        async for _ in self.follow_tuning(tuning_id):
            pass
        return await self.get_tuning(tuning_id)

    async def tune(self, loop: str, key: str | None = None, **how: Unpack[requests.TuningStart]) -> resources.Tuning:
        """Start a tuning, and return it when it has ended."""
        started = await self.start_tuning(loop, key, **how)
        return await self.wait(started.id)

    async def _do(self, call: calls.Call[T]) -> T:
        return call.answer(await self._http.request(**call.request()))
