"""Tunes a plant that lives in the caller's own program: `autotuner.run`, and `autotuner.design` for a model.

The experiment, its supervisor and the restore are those of a configured loop. They run in a thread with an event loop
of their own, so that `run` works in a script, in a notebook and with other threads.

Invariants:

1. Nothing is read or written before all arguments are checked.
2. An exception in the caller's thread (Ctrl-C, SIGTERM, an error of `progress`) ends the experiment. It is raised
   again after the output is restored.
3. The output is not restored when the program is killed (SIGKILL, power): the plant is in the program. A plant that
   must survive that belongs to `autotuner serve` with a driver.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import math
import queue
import signal
import sys
import threading
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotuner.application.analysis.analysed import Context
from autotuner.application.computing.compute_pool import InPlace, Workers
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import LoopTable
from autotuner.control.devices.plugins import is_simulated, make_backend
from autotuner.core.design import DesignSpec, PidDesign
from autotuner.core.design import tune as design_gains
from autotuner.core.verdict import Outcome, aborted
from autotuner.errors import AutotunerError, InputError
from autotuner.validation import validated
from autotuner.virtual_time import event_loop_factory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from autotuner.control.reporting.events import Event
    from autotuner.core.design import DeviceController, PidGains
    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.identification import Identification
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

NAME = "python"
"""Name of the loop in results and reports."""
POLL_S = 0.1
"""Longest time that an exception of the caller's thread waits, s."""


@dataclass(frozen=True, slots=True, repr=False)
class TuningResult:
    """The result of `run`; each part is None where the tuning ended before it.

    Attributes
    ----------
    verdict : Verdict
        The outcome, with its reason and its remedy.
    recording : Recording or None
        The samples.
    identification : Identification or None
        Every estimate, with intervals.
    design : PidDesign or None
        The gains with margins, prediction and alternatives.
    diagnosis : Diagnosis or None
        Effects that a model of the process alone lacks.
    warnings : tuple of str
        What must be known before the gains are used.
    """

    verdict: Verdict
    recording: Recording | None
    identification: Identification | None
    design: PidDesign | None
    diagnosis: Diagnosis | None
    warnings: tuple[str, ...]
    _run: TuningRun
    _loop: LoopTable

    @property
    def done(self) -> bool:
        """Whether there are gains to use."""
        return self.verdict.outcome is Outcome.DONE

    @property
    def model(self) -> ProcessModel | None:
        """The identified process."""
        return self.identification.model if self.identification else None

    @property
    def gains(self) -> PidGains | None:
        """The recommended controller; the one that the device holds where `controller` describes it."""
        if self.design is None:
            return None
        return self.design.held.gains if self.design.held else self.design.gains

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML file, and return its path; raise `InputError` when it cannot be written."""
        from autotuner.commands.files.report import write_report  # noqa: PLC0415 - draws
        from autotuner.commands.files.result_files import write_file  # noqa: PLC0415

        write_file("path", Path(path), partial(write_report, self._run, self._loop))
        return Path(path)

    def plot(self, path: str | Path | None = None) -> Any:
        """Return a matplotlib figure of measurement, model and residual; write it to `path` where one is given.

        Raises
        ------
        InputError
            There is nothing to draw, or the file cannot be written.
        """
        from autotuner.commands.files.result_files import PICTURES, check_writable, write_file  # noqa: PLC0415
        from autotuner.reports.pictures.chart import fit_chart  # noqa: PLC0415
        from autotuner.reports.pictures.figure import draw, figure  # noqa: PLC0415 - matplotlib is slow to load

        if self.recording is None or self.identification is None:
            raise InputError("has nothing to draw", field="result", remedy=f"It ended as {self.verdict.code}.")
        chart = fit_chart(self.recording, self.identification, self._loop.pv_unit, self._loop.output_unit)
        if path is not None:
            check_writable("path", Path(path), PICTURES)
            write_file("path", Path(path), partial(draw, chart))
        return figure(chart)

    def to_dict(self) -> dict[str, object]:
        """Return the complete result, JSON-ready, as `autotuner tune --json` prints it."""
        return self._run.to_dict()

    def __repr__(self) -> str:
        return f"<TuningResult {', '.join(f'{name} {text}' for name, text in self._facts().items())}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>"
            for name, text in self._facts().items()
        )
        notes = "".join(f"<li>{html.escape(warning)}</li>" for warning in self.warnings)
        return f"<table>{rows}</table>" + (f"<ul>{notes}</ul>" if notes else "")

    def _facts(self) -> dict[str, str]:
        """Return a short summary of the available parts of the result."""
        facts = {"verdict": f"{self.verdict.outcome.value}: {self.verdict.message}"}
        if self.model is not None:
            values = ", ".join(f"{name} {value:.4g}" for name, value in self.model.parameters().items())
            facts["model"] = f"{self.model.structure} {values}"
        if (gains := self.gains) is not None and self.design is not None:
            facts["gains"] = f"{gains.words}, b {gains.b:.3g}"
            if self.design.predicted is not None:
                facts["overshoot"] = f"{100.0 * self.design.predicted.overshoot:.0f} %"
        return facts


def run(
    read: Callable[[], Any] | None = None,
    write: Callable[[float], Any] | None = None,
    *,
    sample_time_s: float = 1.0,
    limits: Mapping[str, Any] | tuple[float, float] = (0.0, 100.0),
    output: float | None = None,
    read_output: Callable[[], Any] | None = None,
    simulated: Mapping[str, Any] | None = None,
    process_action: str = "direct",
    goal: str | DesignSpec = "balanced",
    structure: str = "auto",
    budget_ms: float | None = None,
    relay: Mapping[str, Any] | None = None,
    controller: Mapping[str, Any] | None = None,
    pv_unit: str = "",
    output_unit: str = "",
    call_timeout_s: float = 5.0,
    progress: Callable[[Event], Any] | None = None,
) -> TuningResult:
    """Tune a plant through two callables, and return the result.

    Parameters
    ----------
    read, write : callable
        `read` returns the PV, None when there is no value; `write` sets the output. Sync or async.
    sample_time_s, call_timeout_s : float
        Time between two samples, and longest time of one call, s.
    limits : mapping or tuple of float
        Lowest and highest output, or keys of ``[loops.NAME.limits]``: ``output``, ``pv``, ``safe_output``, ...
    output, read_output : float, callable
        The present output, which is restored, or a function that returns it; one of them is needed.
    simulated : mapping, optional
        Options of the driver ``simulated`` instead of `read` and `write`: the tuning then runs in virtual time.
    process_action : str
        ``direct``: a higher output raises the PV; ``reverse``: it lowers the PV.
    goal, structure : str
        ``calm``, ``balanced``, ``brisk`` or a `DesignSpec`; process structure, or ``auto``.
    budget_ms : float, optional
        Processor time of the analysis, ms; where least squares needs more, the learned correction gives the gains.
    relay, controller : mapping, optional
        Keys of ``[loops.NAME.relay]``, such as ``amplitude``, and of ``[loops.NAME.gains]``, such as ``form``: the
        controller that will hold the gains. Without it a controller is assumed that holds the whole design.
    pv_unit, output_unit : str
        Units, for reports.
    progress : callable, optional
        Called with every event in the caller's thread; an exception of it ends the experiment. A notebook needs none.

    Raises
    ------
    InputError, ConfigurationError
        An argument that cannot work; nothing has been called.
    """
    device = _device(read, write, output, read_output, simulated, call_timeout_s)
    units = {"pv_unit": pv_unit, "output_unit": output_unit}
    table = {"sample_time_s": sample_time_s, "process_action": process_action, "relay": dict(relay or {}), **units}
    loop = _loop(device, "simulated" if simulated is not None else NAME, limits, table)
    tuning = _tuning(loop, structure, goal, budget_ms, _controller(controller, sample_time_s))
    _conducted(tuning, loop, make_backend(loop.driver, loop.device, NAME), progress or _in_notebook())
    return _result(tuning, loop)


def _tuning(
    loop: LoopTable,
    structure: str,
    goal: str | DesignSpec,
    budget_ms: float | None,
    controller: DeviceController | None,
) -> TuningRun:
    """Return a tuning that has not begun."""
    settings = loop.experiment_settings()
    spec = goal if isinstance(goal, DesignSpec) else DesignSpec(goal)
    tuning = TuningRun(NAME, NAME, TuningRequest(settings, structure, spec, budget_ms=budget_ms))
    slew_per_s = settings.limits.output_slew_per_s or math.inf
    tuning.context = Context(controller, settings.sample_time_s, settings.limits.output, slew_per_s)
    return tuning


def _in_notebook() -> Callable[[Event], None] | None:
    """Return the callback that prints the progress in a notebook cell; None elsewhere, or without rich."""
    if "IPython" not in sys.modules:
        return None
    try:
        from rich.console import Console  # noqa: PLC0415 - only a notebook needs it
    except ImportError:
        return None
    from autotuner.commands.terminal.progress import Progress  # noqa: PLC0415

    console = Console(highlight=False)
    if not console.is_jupyter:
        return None
    progress = Progress(console.width)

    def show(event: Event) -> None:
        for t, text in progress.take(event):
            console.print(f"{t:8.1f} s  {text}")

    return show


def design(
    model: ProcessModel,
    goal: str = "balanced",
    *,
    rule: str | None = None,
    sample_time_s: float = 0.0,
    controller: Mapping[str, Any] | None = None,
) -> PidDesign:
    """Return PID gains for a process model, with margins, prediction and the gains of every rule.

    Parameters
    ----------
    model : ProcessModel
        The process.
    goal : str
        ``calm``, ``balanced`` or ``brisk``.
    rule : str, optional
        A tuning rule by name instead of a goal.
    sample_time_s : float
        Time between two moves of the controller, s; 0: not known.
    controller : mapping, optional
        As in `run`.

    Raises
    ------
    InputError
        Unknown goal or rule, or a process for which there are no such gains.
    """
    from autotuner.core.design import Basis, design_from_spec, with_prediction  # noqa: PLC0415

    device = _controller(controller, sample_time_s)
    basis = Basis(model, None, (device.scan_s if device else 0.0) or sample_time_s, device=device)
    return with_prediction(design_from_spec(basis, DesignSpec(goal, rule)), basis)


def tune(*args: Any, **kwargs: Any) -> PidDesign:
    """Design gains; deprecated, because it moves no loop: use `autotuner.design`."""
    warnings.warn("autotuner.tune is now autotuner.design", DeprecationWarning, stacklevel=2)
    return design_gains(*args, **kwargs)


def _device(
    read: Callable[[], Any] | None,
    write: Callable[[float], Any] | None,
    output: float | None,
    read_output: Callable[[], Any] | None,
    simulated: Mapping[str, Any] | None,
    call_timeout_s: float,
) -> dict[str, Any]:
    """Return the options of the driver; raise `InputError` for callables that are missing or too many."""
    if simulated is not None:
        if read is not None or write is not None:
            raise InputError("is given beside read and write", field="simulated", remedy="Give one of them.")
        return dict(simulated)
    for name, function in (("read", read), ("write", write)):
        if not callable(function):
            raise InputError("must be a callable", field=name, value=function, remedy=f"Pass {name}=your_function.")
    assert write is not None  # noqa: S101 - checked above
    if read_output is None:
        if output is None:
            raise InputError(
                "is needed, because the output is restored to it",
                field="output",
                remedy="Pass output= or read_output=.",
            )
        remembered = _Remembered(write, float(output))
        write, read_output = remembered.write, remembered.read
    return {"read": read, "write": write, "read_output": read_output, "timeout_s": call_timeout_s}


class _Remembered:
    """An output that is not read back: the last written value is taken for it."""

    def __init__(self, write: Callable[[float], Any], output: float) -> None:
        self._write, self._output = write, output

    def read(self) -> float:
        """Return the output."""
        return self._output

    def write(self, value: float) -> Any:
        """Write the output, sync or async."""
        made = self._write(value)
        self._output = value
        return made


def _loop(
    device: dict[str, Any], driver: str, limits: Mapping[str, Any] | tuple[float, float], table: dict[str, Any]
) -> LoopTable:
    allowed = {"output": tuple(limits)} if isinstance(limits, tuple | list) else dict(limits)
    return validated(LoopTable, {**table, "driver": driver, "device": device, "limits": allowed}, "run")


def _controller(controller: Mapping[str, Any] | None, sample_time_s: float) -> DeviceController | None:
    """Return the controller that will hold the gains; None where it is not described."""
    if controller is None:
        return None
    from autotuner.configuration import GainsTable  # noqa: PLC0415
    from autotuner.control.devices.device_gains import controller_of  # noqa: PLC0415

    table = validated(GainsTable, {"form": "ideal", **controller}, "controller")
    return controller_of(table, sample_time_s, "controller")


def _conducted(tuning: TuningRun, loop: LoopTable, backend: Backend, progress: Callable[[Event], Any] | None) -> None:
    """Conduct the tuning in a thread, and pass its events to the caller; an exception here aborts it first."""
    conductor = _Conductor(tuning, loop, backend)
    with _terminated_as_exception():
        try:
            for event in conductor.events():
                if progress is not None:
                    progress(event)
        except BaseException:
            conductor.abort()
            raise


@contextlib.contextmanager
def _terminated_as_exception() -> Iterator[None]:
    """Let a SIGTERM that would end the program at once raise `SystemExit` instead, so that the output is restored."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _Conductor:
    """A tuning in its own thread."""

    def __init__(self, tuning: TuningRun, loop: LoopTable, backend: Backend) -> None:
        self._tuning, self._loop, self._backend = tuning, loop, backend
        self._events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._event_loop: asyncio.AbstractEventLoop | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="autotuner")

    def events(self) -> Iterator[Event]:
        """Start, and yield every event until the end; raise errors of the thread."""
        self._thread.start()
        while True:
            try:
                event = self._events.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if event is None:
                break
            yield event
        self._thread.join()
        if self._error is not None:
            raise self._error

    def abort(self) -> None:
        """End the experiment, and wait until the output is restored."""
        verdict = aborted("stopped", "the caller stopped the tuning", "Start it again when wanted.")

        def end() -> None:
            with contextlib.suppress(AutotunerError):
                self._tuning.abort(verdict)

        if self._event_loop is not None:
            with contextlib.suppress(RuntimeError):  # it has just ended
                self._event_loop.call_soon_threadsafe(end)
        self._thread.join()

    def _work(self) -> None:
        try:
            with asyncio.Runner(loop_factory=event_loop_factory(virtual=is_simulated(self._backend))) as runner:
                self._event_loop = None if is_simulated(self._backend) else runner.get_loop()
                runner.run(self._conduct())
        except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
            self._error = error
        finally:
            self._events.put(None)

    async def _conduct(self) -> None:
        pool = InPlace() if is_simulated(self._backend) else Workers()
        watcher = asyncio.create_task(self._follow())
        try:
            await self._tuning.conduct(self._loop, self._backend, pool)
            await watcher
        finally:
            watcher.cancel()
            pool.close()

    async def _follow(self) -> None:
        async for event in self._tuning.follow():
            self._events.put(event)


def _result(tuning: TuningRun, loop: LoopTable) -> TuningResult:
    from autotuner.reports.choices import recording_of  # noqa: PLC0415

    assert tuning.verdict is not None  # noqa: S101 - it was conducted to its end
    analysis = tuning.analysis
    return TuningResult(
        tuning.verdict,
        recording_of(tuning),
        analysis.identification if analysis else None,
        analysis.gains if analysis else None,
        analysis.diagnosis if analysis else None,
        tuple(tuning.warnings),
        tuning,
        loop,
    )
