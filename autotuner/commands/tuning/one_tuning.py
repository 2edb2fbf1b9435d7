"""One tuning from the shell: from its options to its results, in real time or in virtual time.

Invariant: whatever cannot work is refused before anything is moved.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.files.audit_trail import keep, note_begun, report_earlier, shell_actor
from autotuner.commands.files.configured import journal_of
from autotuner.commands.files.result_files import Results
from autotuner.commands.terminal.output import OutputError, say, show, writing
from autotuner.commands.terminal.stopping import stoppable
from autotuner.commands.terminal.usage import Number
from autotuner.commands.tuning.design_options import design_spec_of
from autotuner.core.verdict import Outcome, aborted
from autotuner.errors import AutotunerError, ConfigurationError, InputError, TuningStateError
from autotuner.virtual_time import event_loop_factory

if TYPE_CHECKING:
    import argparse
    import signal
    from collections.abc import Callable, Coroutine

    from autotuner.application.gain_service import GainService
    from autotuner.application.loop_processes import LoopProcesses
    from autotuner.application.recovery import Earlier
    from autotuner.application.tuning_run import MakeConductor, TuningRun
    from autotuner.commands.tuning.also_record import AlsoRecorded
    from autotuner.configuration import Configuration, LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.records.journal import Journal
    from autotuner.control.records.lease_record import LeaseRecord
    from autotuner.control.verification.verification_run import VerificationRun
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.recording import Recording
    from autotuner.ports import Backend

POSITIVE = Number(above=0.0)
RELAY_OPTIONS: dict[str, tuple[Number, str]] = {
    "amplitude": (POSITIVE, "half the relay swing, output units"),
    "ratio": (Number(low=1.0), "upper over lower part of the swing; 1 is symmetric"),
    "pv_amplitude": (POSITIVE, "wanted amplitude of the PV, zero to peak, to which the relay amplitude is adapted"),
    "max_amplitude": (POSITIVE, "largest relay amplitude that adaptation may reach, output units"),
    "hysteresis": (Number(low=0.0), "half width of the relay's dead zone, PV units"),
    "quiet_s": (POSITIVE, "time to watch the loop at rest, s"),
    "accuracy": (POSITIVE, "relative standard error at which the relay stops"),
    "response_limit_s": (POSITIVE, "longest wait for the first answer, s"),
    "time_limit_s": (POSITIVE, "longest time for everything, s"),
}
"""Options of the relay: type and help."""


class OneTuning:
    """A tuning of one loop, from its options to its results; whatever cannot work is refused here."""

    def __init__(self, configuration: Configuration, args: argparse.Namespace, *, close: bool = False) -> None:
        from autotuner.application.gain_service import GainService  # noqa: PLC0415 - keeps `--help` quick
        from autotuner.application.loop_processes import loop_processes  # noqa: PLC0415
        from autotuner.application.manager import random_id  # noqa: PLC0415
        from autotuner.application.tuning_run import TuningRequest, TuningRun  # noqa: PLC0415
        from autotuner.commands.terminal.show import SIMULATED  # noqa: PLC0415
        from autotuner.control.devices.plugins import is_simulated, make_backend  # noqa: PLC0415

        name = args.loop or _only(list(configuration.loops))
        self.args, self._service, self.loop = args, configuration.service, configuration.loop(name)
        settings, spec = _settings(self.loop, args), design_spec_of(args)
        request = TuningRequest(settings, args.structure, spec, shell_actor(), args.budget_ms)
        self.backend = make_backend(self.loop.driver, self.loop.device, f"loops.{name}")
        self.simulated = is_simulated(self.backend)
        self.tuning = TuningRun(SIMULATED if self.simulated else random_id(), name, request)
        self._journal = journal_of(configuration)
        processes = loop_processes()
        gain_service = GainService(name, self.loop, self.backend, self._journal, processes)
        self.after = _After(gain_service, processes, apply=args.apply, verify=args.verify, close=close)
        self.also = _also_recorded(configuration, name, args, processes)

    @property
    def virtual(self) -> bool:
        """Whether time jumps: a simulated loop ends with this program, and need not wait."""
        return self.simulated and not self.args.real_time

    def conduct(self) -> None:
        """Run to the end."""
        run_until_end(self.work(), self.abort, virtual=self.virtual)

    async def work(self) -> None:
        """Tune, and use the gains as requested; nothing of a simulated loop is stored."""
        if self.simulated:
            async with _along(self.also, self.tuning):
                await _conduct(self.tuning, self.loop, self.backend, self.after, virtual=self.virtual)
            return
        action = f"autotuner tune {self.tuning.loop}{self.after.option}"
        report_interrupted = partial(report_earlier, self._service)
        begun = partial(note_begun, self._service, action, self.tuning.loop, self.tuning.id)
        along = _along(self.also, self.tuning)
        try:
            await _conduct_kept(
                self.tuning, self.loop, self.backend, self.after, self._journal, report_interrupted, begun, along
            )
        finally:
            keep(self._service, self.tuning)

    def abort(self, number: signal.Signals) -> None:
        """End the tuning by a signal as an abort does: through the restore."""
        with contextlib.suppress(TuningStateError):  # it has just ended
            self.tuning.abort(aborted("signal", f"stopped by {number.name}", "Start it again when wanted."))

    def _recording(self) -> Recording:
        recording = self.tuning.recording()
        return self.also.with_column(recording) if self.also else recording

    def show(self, *, printed: bool = True) -> int:
        """Write the files, then print the result unless another does, and report trouble; return the exit code."""
        results = Results(Path(self._service.data_directory), f"{self.tuning.loop}-{self.tuning.started_at}")
        code = self._write_files(results)
        try:
            if printed:
                self._print()
        except OutputError as error:
            if not isinstance(error.__cause__, BrokenPipeError):
                say(error)
                results.keep("result.json", lambda place: place.write_text(self._json(), encoding="utf-8"))
                return 1
        return max(code, 0 if self.tuning.succeeded else 1, self.after.report())

    def _write_files(self, results: Results) -> int:
        from autotuner.commands.files.report import write_report  # noqa: PLC0415

        tuning, loop, args = self.tuning, self.loop, self.args
        codes = [0]
        if len(tuning.samples) > 1:
            codes.append(
                results.write("--recording", args.recording, lambda file: file.write_text(self._recording().to_csv()))
            )
        if tuning.analysis is not None and args.picture is not None:
            from autotuner.reports.pictures.chart import fit_chart  # noqa: PLC0415
            from autotuner.reports.pictures.figure import draw  # noqa: PLC0415 - matplotlib is slow to load

            chart = fit_chart(tuning.recording(), tuning.analysis.identification, loop.pv_unit, loop.output_unit)
            codes.append(results.write("--picture", args.picture, lambda file: draw(chart, file)))
        codes.append(results.write("--report", args.report, partial(write_report, tuning, loop)))
        return max(codes)

    def _print(self) -> None:
        if self.args.json:
            show(self._json())
            return
        from autotuner.commands.terminal.show import show_tuning  # noqa: PLC0415

        with writing():
            show_tuning(self.tuning, self.loop, self.args)

    def _json(self) -> str:
        return json.dumps(self.tuning.to_dict()) + "\n"


def _along(also: AlsoRecorded | None, tuning: TuningRun) -> contextlib.AbstractAsyncContextManager[None]:
    """Return the context of the tuning, in which the other loop is read along where requested."""
    return also.along(tuning) if also else contextlib.nullcontext()


def _also_recorded(
    configuration: Configuration, tuned: str, args: argparse.Namespace, processes: LoopProcesses | None
) -> AlsoRecorded | None:
    """Return the other loop that is read along; raise `InputError` where that would lead to nothing."""
    from autotuner.application.operations import Operations  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.commands.tuning.also_record import AlsoRecorded  # noqa: PLC0415 - brings NumPy with it
    from autotuner.control.devices.plugins import make_backend  # noqa: PLC0415
    from autotuner.control.records.gains_ledger import GainsLedger  # noqa: PLC0415

    name = args.also_record
    if name is None:
        return None
    other = configuration.loop(name)
    problems = {"is the tuned loop itself": name == tuned, "needs --recording FILE": args.recording is None}
    if problem := next((text for text, holds in problems.items() if holds), None):
        raise InputError(problem, field="--also-record", value=name, remedy="Name another loop, and --recording FILE.")
    backend = make_backend(other.driver, other.device, f"loops.{name}")
    return AlsoRecorded(name, Operations(name, other, backend, GainsLedger(None, name), processes))


def _settings(loop: LoopTable, args: argparse.Namespace) -> ExperimentSettings:
    given = {option: getattr(args, option) for option in RELAY_OPTIONS} | {
        "check": False if args.no_check else None,
        "side": args.side,
        "drift_compensation": args.drift_compensation or None,
        "online": args.online,
    }
    return loop.experiment_settings(**given)


def _only(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    raise ConfigurationError("name the loop to tune", field="loop", remedy=f"Use one of {', '.join(names)}.")


def run_until_end(
    work: Coroutine[object, object, None], abort: Callable[[signal.Signals], None], *, virtual: bool
) -> None:
    """Run on the wall clock, or in virtual time; a signal calls `abort`."""
    with asyncio.Runner(loop_factory=event_loop_factory(virtual=virtual)) as runner:
        runner.run(stoppable(work, abort))


class _After:
    """Actions on the gains of a tuning; refused before the tuning where they are impossible."""

    def __init__(
        self,
        gain_service: GainService,
        processes: LoopProcesses | None,
        *,
        apply: bool,
        verify: float | None,
        close: bool,
    ) -> None:
        self.gain_service, self.processes = gain_service, processes
        self._apply, self._verify, self._close = apply or verify is not None, verify, close
        self.closed = False
        self._trouble: AutotunerError | None = None
        self._code = 0
        if self._apply:
            gain_service.writer()

    @property
    def option(self) -> str:
        """The request as typed at the shell."""
        return " --verify" if self._verify is not None else " --apply" if self._apply else ""

    async def do(self, tuning: TuningRun, loop: LoopTable, pool: ComputePool) -> None:
        """Apply the actions; store an error, because the result of the tuning is shown nevertheless."""
        if not (self._apply and tuning.succeeded):
            return
        from autotuner.commands.terminal.progress import show_verification  # noqa: PLC0415 - keeps `--help` quick

        shown: list[asyncio.Task[None]] = []

        def watch(run: VerificationRun) -> None:
            shown.append(asyncio.create_task(show_verification(run, loop)))

        try:
            run = await self.gain_service.use(
                tuning, None if self._verify is None else pool, self._verify or None, watch
            )
            self._code = 0 if run is None or run.passed else 1
            await asyncio.gather(*shown)
            if self._close and not self._code:
                await self._close_loop(tuning)
        except AutotunerError as error:
            self._trouble = error
        finally:
            for task in shown:
                task.cancel()

    async def _close_loop(self, tuning: TuningRun) -> None:
        verdict = await self.gain_service.close_loop(tuning)
        self.closed = verdict.outcome is Outcome.DONE
        if not self.closed:
            self._trouble = AutotunerError(
                f"{tuning.loop} is not closed: {verdict.message}", remedy=f"{verdict.remedy} Then close it by hand."
            )

    def report(self) -> int:
        """Report the trouble on standard error; return the exit code."""
        if self._trouble is None:
            return self._code
        say(self._trouble)
        return 1


async def _conduct_kept(
    tuning: TuningRun,
    loop: LoopTable,
    backend: Backend,
    after: _After,
    journal: Journal,
    report_interrupted: Callable[[LeaseRecord, Earlier], None],
    begun: Callable[[], None],
    along: contextlib.AbstractAsyncContextManager[None],
) -> None:
    """Release the interrupted runs of this loop, then conduct a recorded tuning.

    A loop process drives the loop: a command that is stopped or killed leaves no relay.
    """
    from autotuner.application.recovery import recover_first  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.application.remote_controller import RemoteController  # noqa: PLC0415
    from autotuner.control.devices.retrying import to_its_end  # noqa: PLC0415

    processes, operations = after.processes, after.gain_service.operations

    def conductor(pool: ComputePool) -> MakeConductor | None:
        if processes is None:
            return None
        return lambda tuning, _loop, _backend: RemoteController(tuning, operations, processes, pool)

    try:
        async with along:
            for kept, shown in await recover_first(tuning.loop, loop, backend, journal, processes):
                report_interrupted(kept, shown)
            tuning.journal = journal.begin(tuning.head(loop.device_key))
            begun()
            await _conduct(tuning, loop, backend, after, virtual=False, conductor=conductor)
    finally:
        if processes is not None:
            await to_its_end(processes.close())


async def _conduct(
    tuning: TuningRun,
    loop: LoopTable,
    backend: Backend,
    after: _After,
    *,
    virtual: bool,
    conductor: Callable[[ComputePool], MakeConductor | None] = lambda _: None,
) -> None:
    from autotuner.application.computing.compute_pool import InPlace, Workers  # noqa: PLC0415
    from autotuner.application.tuning_run import here  # noqa: PLC0415
    from autotuner.commands.terminal.progress import show_progress  # noqa: PLC0415 - keeps `--help` quick

    pool = InPlace() if virtual else Workers()
    watcher = asyncio.create_task(show_progress(tuning, loop))
    try:
        await tuning.conduct(loop, backend, pool, conductor(pool) or here)
        await watcher
        await after.do(tuning, loop, pool)
    finally:
        watcher.cancel()
        pool.close()
