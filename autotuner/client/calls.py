"""Calls to the service as values: request and parser of the answer. Nothing here sends.

Invariant: a call has the name that the service's API document gives it (`operationId`); a test compares all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter

from autotuner.client.errors import check
from autotuner.service.schemas import monitoring, operation, resources, views
from autotuner.service.schemas.diagnosis import Diagnosis, DiagnosisCurves

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import httpx

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

TIMEOUT_S = 600.0
"""Longest wait for an answer, s: a verification is answered at its end."""
PROBLEM_TYPES = TypeAdapter(list[operation.ProblemType])


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """A request, and how its answer is read.

    Attributes
    ----------
    method, path : str
        The request; the path is quoted.
    read : callable
        Takes the answer of a request that succeeded.
    query : mapping
        Parameters; None is omitted.
    headers : mapping
        Further headers.
    body : mapping or None
        The body, as JSON.
    csv : bytes or None
        The body, as CSV.
    """

    method: str
    path: str
    read: Callable[[httpx.Response], T]
    query: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Mapping[str, Any] | None = None
    csv: bytes | None = None

    def request(self) -> dict[str, Any]:
        """Return the arguments of httpx's `build_request`."""
        params = {name: value for name, value in self.query.items() if value is not None}
        arguments: dict[str, Any] = {"method": self.method, "url": self.path, "params": params, "headers": self.headers}
        if self.body is not None:
            arguments["json"] = dict(self.body)
        if self.csv is not None:
            arguments |= {"content": self.csv, "headers": {**self.headers, "content-type": "text/csv"}}
        return arguments

    def answer(self, response: httpx.Response) -> T:
        """Return the content of an answer; raise `ServiceError` where that is a problem."""
        check(response)
        return self.read(response)


def healthz() -> Call[operation.Health]:
    """Ask whether the process answers."""
    return Call("GET", "/healthz", _as(operation.Health))


def readyz(loop: str | None) -> Call[operation.Readiness]:
    """Ask whether tunings can be started and kept, and for each loop's link."""
    return Call("GET", "/readyz", _as(operation.Readiness), {"loop": loop})


def get_metrics() -> Call[str]:
    """Return the counters, in the text format of Prometheus."""
    return Call("GET", "/metrics", _text)


def list_audit(limit: int | None, before: int | None, loop: str | None, actor: str | None) -> Call[operation.Audit]:
    """Return the audit."""
    filters = {"limit": limit, "before": before, "loop": loop, "actor": actor}
    return Call("GET", "/v1/audit", _as(operation.Audit), filters)


def reload_configuration() -> Call[operation.Reloaded]:
    """Have the configuration file read again."""
    return Call("POST", "/v1/reload", _as(operation.Reloaded))


def list_problem_types() -> Call[list[operation.ProblemType]]:
    """List the kinds of problems that the service reports."""
    return Call("GET", "/v1/problems", lambda response: PROBLEM_TYPES.validate_json(response.content))


def list_loops() -> Call[resources.Loops]:
    """List the configured loops."""
    return Call("GET", "/v1/loops", _as(resources.Loops))


def get_loop(loop: str) -> Call[resources.Loop]:
    """Return one loop."""
    return Call("GET", _loop(loop), _as(resources.Loop))


def list_readings(loop: str | None) -> Call[resources.Readings]:
    """Return the readings of the loops."""
    return Call("GET", "/v1/readings", _as(resources.Readings), {"loop": loop})


def start_monitor(loop: str, body: Mapping[str, Any]) -> Call[monitoring.Monitoring]:
    """Watch a loop in its normal running."""
    return Call("POST", _loop(loop, "/monitor"), _as(monitoring.Monitoring), body=body)


def get_monitor(loop: str) -> Call[monitoring.Monitoring]:
    """Return the result of monitoring a loop."""
    return Call("GET", _loop(loop, "/monitor"), _as(monitoring.Monitoring))


def end_monitor(loop: str) -> Call[monitoring.Monitoring]:
    """Watch a loop no more."""
    return Call("DELETE", _loop(loop, "/monitor"), _as(monitoring.Monitoring))


def get_device_gains(loop: str) -> Call[resources.LoopGains]:
    """Read the gains that a device holds now."""
    return Call("GET", _loop(loop, "/gains"), _as(resources.LoopGains))


def plan_tuning(loop: str, output: float | None, body: Mapping[str, Any]) -> Call[views.Plan]:
    """Return the plan of a tuning."""
    return Call("POST", _loop(loop, "/plan"), _as(views.Plan), {"output": output}, body=body)


def start_tuning(loop: str, key: str | None, body: Mapping[str, Any]) -> Call[resources.Tuning]:
    """Start a tuning; sent again with the same key it starts no other."""
    headers = {} if key is None else {"idempotency-key": key}
    return Call("POST", _loop(loop, "/tunings"), _as(resources.Tuning), headers=headers, body=body)


def list_tunings(loop: str | None, limit: int | None) -> Call[resources.Tunings]:
    """List the tunings, the newest first."""
    return Call("GET", "/v1/tunings", _as(resources.Tunings), {"loop": loop, "limit": limit})


def get_tuning(tuning_id: str) -> Call[resources.Tuning]:
    """Return a tuning."""
    return Call("GET", _tuning(tuning_id), _as(resources.Tuning))


def abort_tuning(tuning_id: str) -> Call[resources.Tuning]:
    """End a running tuning; its output is restored at once."""
    return Call("POST", _tuning(tuning_id, "/abort"), _as(resources.Tuning))


def get_recording(tuning_id: str) -> Call[str]:
    """Return the recording so far, as CSV text."""
    return Call("GET", _tuning(tuning_id, "/recording"), _text, {"format": "csv"})


def get_report(tuning_id: str) -> Call[str]:
    """Return the report of a tuning, as HTML."""
    return Call("GET", _tuning(tuning_id, "/report"), _text)


def export_tuning(tuning_id: str) -> Call[str]:
    """Return a tuning as one file, for `autotuner replay`."""
    return Call("GET", _tuning(tuning_id, "/export"), _text)


def get_curves(tuning_id: str, most: int | None) -> Call[views.Curves]:
    """Return measured and simulated PV and the residual."""
    return Call("GET", _tuning(tuning_id, "/curves"), _as(views.Curves), {"most": most})


def get_before_and_after(tuning_id: str, most: int | None) -> Call[DiagnosisCurves]:
    """Return measured PV and the simulated one without and with the effects that the diagnosis names."""
    return Call("GET", _tuning(tuning_id, "/before-after"), _as(DiagnosisCurves), {"most": most})


def get_choices(tuning_id: str) -> Call[views.Choices]:
    """Return the gains of every goal side by side."""
    return Call("GET", _tuning(tuning_id, "/choices"), _as(views.Choices))


def compute_gains(tuning_id: str, body: Mapping[str, Any]) -> Call[resources.Gains]:
    """Compute other gains from the identified model."""
    return Call("POST", _tuning(tuning_id, "/gains"), _as(resources.Gains), body=body)


def apply_gains(tuning_id: str, body: Mapping[str, Any]) -> Call[resources.Applied]:
    """Write the gains to the device and read them back."""
    return Call("POST", _tuning(tuning_id, "/apply"), _as(resources.Applied), body=body)


def verify_gains(tuning_id: str, step: float | None) -> Call[resources.VerificationResult]:
    """Make a small set-point step under the gains that were applied."""
    return Call("POST", _tuning(tuning_id, "/verify"), _as(resources.VerificationResult), body={"step": step})


def roll_back(tuning_id: str, *, force: bool) -> Call[resources.RolledBack]:
    """Put the gains back that the device had before."""
    return Call("POST", _tuning(tuning_id, "/rollback"), _as(resources.RolledBack), body={"force": force})


def start_schedule(loop: str, body: Mapping[str, Any]) -> Call[resources.ScheduleRun]:
    """Tune at several set points, one after the other."""
    return Call("POST", _loop(loop, "/schedules"), _as(resources.ScheduleRun), body=body)


def get_schedule(schedule_id: str) -> Call[resources.ScheduleRun]:
    """Return a run over operating points."""
    return Call("GET", f"/v1/schedules/{quote(schedule_id, safe='')}", _as(resources.ScheduleRun))


def abort_schedule(schedule_id: str) -> Call[resources.ScheduleRun]:
    """End a run over operating points."""
    return Call("POST", f"/v1/schedules/{quote(schedule_id, safe='')}/abort", _as(resources.ScheduleRun))


def combine_tunings(body: Mapping[str, Any]) -> Call[resources.Schedule]:
    """Make a schedule of the gains of several tunings."""
    return Call("POST", "/v1/schedules", _as(resources.Schedule), body=body)


def identify(csv: bytes, query: Mapping[str, Any]) -> Call[views.Identification]:
    """Identify a process from a recording."""
    return Call("POST", "/v1/identifications", _as(views.Identification), query, csv=csv)


def diagnose(csv: bytes, query: Mapping[str, Any]) -> Call[Diagnosis]:
    """Diagnose a recording: effects that it shows and a model lacks."""
    return Call("POST", "/v1/diagnoses", _as(Diagnosis), query, csv=csv)


def follow_tuning(tuning_id: str, last: int) -> Call[None]:
    """Follow a tuning after the event of index `last`; -1 from the first one. The answer is a stream."""
    return Call("GET", _tuning(tuning_id, "/events"), lambda _: None, headers={"last-event-id": str(last)})


def follow_verification(tuning_id: str, last: int) -> Call[None]:
    """Follow the latest verification of a tuning after the event of index `last`; -1 from the first one."""
    path = _tuning(tuning_id, "/verification/events")
    return Call("GET", path, lambda _: None, headers={"last-event-id": str(last)})


def _as(kind: type[M]) -> Callable[[httpx.Response], M]:
    return lambda response: kind.model_validate_json(response.content)


def _text(response: httpx.Response) -> str:
    return response.text


def _loop(loop: str, rest: str = "") -> str:
    return f"/v1/loops/{quote(loop, safe='')}{rest}"


def _tuning(tuning_id: str, rest: str = "") -> str:
    return f"/v1/tunings/{quote(tuning_id, safe='')}{rest}"
