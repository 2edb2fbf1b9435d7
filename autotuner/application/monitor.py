"""Watching loops in their normal running, after a tuning: nothing is ever written.

    sample every `every_s` -> the last `window_s` -> every quarter of it: measured against expected, in a worker

Invariants:

1. Only reads, each as a visit of its own, so that a device that serves one client stays free between two samples.
2. A tuning has precedence: while one holds the loop nothing is read, and the window restarts after it.
3. The report is that of the last complete judgement; a link that is lost for a while leaves a gap, and the window
   restarts.
4. A monitor lives until it is ended, another is started on its loop, or the service ends.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from autotuner.application.computing.computations import findings
from autotuner.control.clock.call_timeout import LONGEST_CALL_S
from autotuner.control.clock.ticker import Ticker, utc_now
from autotuner.control.devices.device_polling import Polled, resets
from autotuner.control.driving.drive import drive
from autotuner.control.driving.lease import Lease
from autotuner.control.reporting.events import LinkTrouble
from autotuner.core.design import gains_from_dict, ultimate_point
from autotuner.core.model.process import model_from_dict
from autotuner.core.monitoring import Expected
from autotuner.core.recording import Recording, Sample
from autotuner.core.safety.supervisor import SafetySettings, Supervisor
from autotuner.errors import AutotunerError, InputError, ShuttingDownError, TuningStateError
from autotuner.ports import OUTPUT, PV, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from autotuner.application.loops import Loops
    from autotuner.control.reporting.events import Event
    from autotuner.core.monitoring import Findings
    from autotuner.core.verdict import Verdict

PERIODS, A_PERIOD = 120.0, 20.0
"""Ultimate periods in a window, and samples in one of them."""
FEWEST = 200
"""Samples from which a window is judged."""
MOST = 20_000
"""Most samples in a window: they bound its memory, and the time of one judgement."""
QUARTER = 4
"""Number of judgements in one window: a window is judged again after this fraction of it."""
GAP = 5.0
"""Number of missed samples after which the window restarts."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class MonitorPlan:
    """Configuration of a monitor.

    Attributes
    ----------
    loop, tuning_id : str
        The loop, and the tuning whose model gives the expected behaviour.
    expected : Expected
        Process and gains.
    every_s, window_s : float
        Sample time, and length of the judged window, s.
    """

    loop: str
    tuning_id: str
    expected: Expected
    every_s: float
    window_s: float


def plan_of(result: Mapping[str, Any], sample_time_s: float, window_s: float | None = None) -> MonitorPlan:
    """Return how to watch a loop by the result of a tuning.

    Parameters
    ----------
    result : mapping
        As `TuningRun.to_dict` makes it.
    sample_time_s : float
        That of the loop, s: it is never read more often.
    window_s : float, optional
        Length of the judged window, s; some hundred periods of the loop by default.

    Raises
    ------
    TuningStateError
        It identified no process.
    InputError
        A window that holds too few samples, or more than are kept.
    """
    if not result.get("model"):
        raise TuningStateError(
            "has identified no process, so nothing can be expected of its loop",
            field="tuning",
            value=result["id"],
            remedy="Give a tuning that ended with a model.",
        )
    model = model_from_dict(result["model"], result["structure"])
    estimate = result["estimates"].get(result["recommended"]) or {}
    intervals = {name: (low, high) for name, (low, high) in (estimate.get("interval95") or {}).items()}
    written = (result.get("applied") or {}).get("now") or result.get("tuning") or {}
    gains = gains_from_dict(written["gains"]) if written.get("gains") else None
    point = ultimate_point(model)
    period_s = point.Pu if point else 4.0 * model.D + sample_time_s * A_PERIOD
    every_s = max(sample_time_s, period_s / A_PERIOD)
    chosen_s = PERIODS * period_s if window_s is None else window_s
    if not FEWEST * every_s <= chosen_s <= MOST * every_s:
        raise InputError(
            f"holds too few or too many samples at one every {every_s:.3g} s",
            field="window_s",
            value=chosen_s,
            remedy=f"Give {FEWEST * every_s:.3g} to {MOST * every_s:.3g}, or leave it out.",
        )
    return MonitorPlan(result["loop"], result["id"], Expected(model, intervals, gains), every_s, chosen_s)


class Monitor:
    """A monitored loop: a stage of a drive that never writes; its lease holds nothing.

    Parameters
    ----------
    plan : MonitorPlan
        What is watched.
    """

    phase, doubt, complete = "monitoring", "", False

    def __init__(self, plan: MonitorPlan) -> None:
        self.plan, self.started_at = plan, utc_now()
        self.findings: Findings | None = None
        self.judged_at: str | None = None
        self.trouble: str | None = None
        self.unjudged: str | None = None
        self._samples = deque[Sample](maxlen=math.ceil(plan.window_s / plan.every_s))
        self._fresh = 0
        self._judging: asyncio.Task[None] | None = None
        self._due: Callable[[], Coroutine[object, object, None]]

    async def conduct(self, manager: Loops) -> None:
        """Watch until cancelled."""
        table, backend = manager.device(self.plan.loop)
        polled = Polled(backend, lambda work: manager.visit(self.plan.loop, work), (PV, OUTPUT, SET_POINT))
        limits = table.experiment_settings().limits
        supervisor = Supervisor(limits, SafetySettings(pv_timeout_s=LONGEST_CALL_S, max_lateness_s=math.inf))
        lease = Lease(
            polled, limits, supervisor, Ticker(self.plan.every_s), 0.0, publish=self._take_trouble, watch=self
        )
        self._due = lambda: self._judge(manager)
        try:
            await drive(lease, self)
        finally:
            if self._judging is not None:
                self._judging.cancel()
                await asyncio.gather(self._judging, return_exceptions=True)

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample, and have the window judged where that is due; nothing is ever written."""
        self.trouble = None
        if self._samples and sample.t - self._samples[-1].t > GAP * self.plan.every_s:
            self._samples.clear()
        self._samples.append(sample)
        self._fresh += 1
        if self._is_due and (self._judging is None or self._judging.done()):
            self._fresh = 0
            self._judging = asyncio.create_task(self._due(), name=f"judge-{self.plan.loop}")
        return {}

    @property
    def _is_due(self) -> bool:
        window = self._samples.maxlen or 0
        return len(self._samples) >= min(FEWEST, window) and self._fresh >= max(window // QUARTER, 1)

    def record(self, sample: Sample) -> None:
        """Do nothing: the window holds the samples."""

    def correct(self, output: float) -> None:
        """Do nothing: the device moves its output."""

    def tolerates(self, _verdict: Verdict) -> bool:
        """Return True: nothing ends the watching."""
        return True

    def check(self, _sample: Sample, *, auto: float | None, phase: str, still_s: float) -> None:
        """Do nothing: a loop in its normal running is not supervised."""

    def check_failure(self, _t: float, _still_s: float, _failure: AutotunerError) -> None:
        """Do nothing: a link that is dead leaves a gap."""

    def _take_trouble(self, event: Event) -> None:
        if isinstance(event, LinkTrouble):
            self.trouble = event.message

    async def _judge(self, manager: Loops) -> None:
        recording = Recording.from_samples(list(self._samples))
        try:
            self.findings = await manager.pool.run(findings, recording, self.plan.expected)
        except AutotunerError as error:
            self.unjudged = f"the last window could not be judged: {error}"
        except Exception as error:  # noqa: BLE001 - whatever it was, the watching goes on
            _log.exception("judging a window failed")
            self.unjudged = f"the last window could not be judged: {type(error).__name__}: {error}"
        else:
            self.judged_at, self.unjudged = utc_now(), None

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        span_s = self._samples[-1].t - self._samples[0].t if self._samples else 0.0
        return {
            "loop": self.plan.loop,
            "state": "watching",
            "tuning_id": self.plan.tuning_id,
            "started_at": self.started_at,
            "every_s": self.plan.every_s,
            "window_s": self.plan.window_s,
            "seen_s": span_s,
            "judged_at": self.judged_at,
            "findings": self.findings.to_dict() if self.findings else None,
            "trouble": self.trouble or self.unjudged,
        }


class Monitors:
    """The loops of one service that are watched.

    Parameters
    ----------
    manager : Manager
        Has the loops.
    """

    def __init__(self, manager: Loops) -> None:
        self._manager = manager
        self._watched: dict[str, tuple[Monitor, asyncio.Task[None]]] = {}

    def start(self, plan: MonitorPlan) -> Monitor:
        """Start the monitor of a loop, and replace an earlier one.

        Raises
        ------
        UnknownLoopError
            No such loop.
        InputError
            The device cannot be polled without disturbing it, or does not report its output.
        ShuttingDownError
            The manager is being closed.
        """
        backend = self._manager.device(plan.loop)[1]
        if self._manager.closing:
            raise ShuttingDownError
        if resets(backend) or not {PV, OUTPUT} <= backend.readable:
            raise InputError(
                "cannot be watched: its output cannot be read, or connecting disturbs its device",
                field="loop",
                value=plan.loop,
                remedy="Map the output for reading; a board that is reset by a connection can only be tuned.",
            )
        self.end(plan.loop)
        monitor = Monitor(plan)
        task = asyncio.create_task(self._kept_up(monitor), name=f"monitor-{plan.loop}")
        self._watched[plan.loop] = monitor, task
        return monitor

    async def _kept_up(self, monitor: Monitor) -> None:
        """Watch; a fault ends the watching of this loop only, and its view reports it."""
        try:
            await monitor.conduct(self._manager)
        except Exception as error:  # noqa: BLE001 - whatever it was, tunings go on
            _log.exception("watching a loop failed")
            monitor.trouble = f"the watching ended: {error}"

    def of(self, loop: str) -> Monitor | None:
        """Return the monitor of a loop; None where it is not watched. Raise `UnknownLoopError` for no loop."""
        self._manager.device(loop)
        found = self._watched.get(loop)
        return found[0] if found else None

    def end(self, loop: str) -> None:
        """Watch a loop no more; raise `UnknownLoopError` for no loop."""
        self._manager.device(loop)
        self.forget(loop)

    def forget(self, loop: str) -> None:
        """Watch a loop no more that need not exist any more."""
        _, task = self._watched.pop(loop, (None, None))
        if task is not None:
            task.cancel()

    async def close(self) -> None:
        """Watch nothing any more."""
        tasks = [task for _, task in self._watched.values()]
        self._watched.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
