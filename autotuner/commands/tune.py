"""`autotuner tune`: one tuning from the shell, with live progress.

A loop whose driver says that it is simulated runs in virtual time unless `--real-time` is given: the same code on an
event loop whose time jumps to the next deadline.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.stopping import stoppable
from autotuner.commands.told import BEGUN, keep, note, shell_actor, tell_earlier
from autotuner.commands.wishes import add_wish, wish_of
from autotuner.configuration import load_configuration
from autotuner.core.verdict import aborted
from autotuner.errors import AutotunerError, ConfigurationError, TuningStateError

if TYPE_CHECKING:
    import argparse
    import signal
    from collections.abc import Callable, Coroutine

    from autotuner.configuration import LoopTable
    from autotuner.ports import Backend
    from autotuner.runtime.arithmetic import Arithmetic
    from autotuner.runtime.gains_desk import GainsDesk
    from autotuner.runtime.journal import Journal
    from autotuner.runtime.journal_file import Kept
    from autotuner.runtime.recovery import Earlier
    from autotuner.runtime.tuning import Tuning

RELAY_OPTIONS = {
    "amplitude": "half the relay swing, output units",
    "ratio": "upper over lower part of the swing; 1 is symmetric",
    "pv_amplitude": "wished amplitude of the PV, zero to peak, to which the relay amplitude is adapted",
    "max_amplitude": "largest relay amplitude that adaptation may reach, output units",
    "hysteresis": "half width of the relay's dead zone, PV units",
    "quiet_s": "time to watch the loop at rest, s",
    "accuracy": "relative standard error at which the relay stops",
    "response_limit_s": "longest wait for the first answer, s",
    "time_limit_s": "longest time for everything, s",
}


@dataclass(frozen=True, slots=True)
class TuneCommand:
    """Tune one loop."""

    help: str = (
        "Tune a loop: relay experiment, model with its errors, gains. Without arguments a simulated loop is tuned."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("loop", nargs="?", help="the loop's name; may be left out when there is only one")
        parser.add_argument(
            "--config", type=Path, help="TOML file of loops (default: autotuner.toml, else a demo loop)"
        )
        for name, text in RELAY_OPTIONS.items():
            parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=text)
        parser.add_argument(
            "--online",
            type=controller,
            metavar="KP,TI,TD",
            help="keep this controller running beside the relay: ideal form, times in s; without TD no derivative, "
            "without TI no integral action",
        )
        parser.add_argument("--side", choices=("heat", "cool"), help="side of output zero on which the relay stays")
        parser.add_argument(
            "--drift-compensation",
            action="store_true",
            help="follow a PV that drifts at rest, instead of refusing it",
        )
        parser.add_argument("--no-check", action="store_true", help="leave out the check after the relay")
        parser.add_argument("--structure", default="auto", help="process structure to identify")
        add_wish(parser)
        parser.add_argument("--apply", action="store_true", help="write the gains into the device, and read them back")
        parser.add_argument(
            "--verify",
            nargs="?",
            type=float,
            const=0.0,
            metavar="STEP",
            help="write the gains, then make a small set-point step (STEP, PV units) under them: the old gains go back "
            "unless the loop does what was predicted",
        )
        parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
        parser.add_argument("--picture", type=Path, metavar="FILE", help="draw measured and model to a PNG, SVG or PDF")
        parser.add_argument("--report", type=Path, metavar="FILE", help="write everything as one HTML file")
        parser.add_argument("--recording", type=Path, metavar="FILE", help="write the recording as CSV")
        parser.add_argument("--real-time", action="store_true", help="run a simulated loop on the wall clock too")

    def run(self, args: argparse.Namespace) -> int:
        """Tune and show the result."""
        from autotuner.runtime.gains_desk import GainsDesk  # noqa: PLC0415 - keeps `--help` quick
        from autotuner.runtime.journal import Journal  # noqa: PLC0415
        from autotuner.runtime.manager import random_id  # noqa: PLC0415
        from autotuner.runtime.plugins import is_simulated, make_backend  # noqa: PLC0415
        from autotuner.runtime.tuning import Tuning, TuningRequest  # noqa: PLC0415

        configuration = load_configuration(args.config)
        name = args.loop or _only(list(configuration.loops))
        loop = configuration.loop(name)
        overrides = {option: getattr(args, option) for option in RELAY_OPTIONS} | {
            "check": False if args.no_check else None,
            "side": args.side,
            "drift_compensation": args.drift_compensation or None,
            "online": args.online,
        }
        settings = loop.experiment_settings(**overrides)
        request = TuningRequest(settings, args.structure, wish_of(args), shell_actor())
        backend = make_backend(loop.driver, loop.device, f"loops.{name}")
        journal = Journal(Path(configuration.service.data_directory))
        desk = GainsDesk(name, loop, backend, journal)  # who stands by for the tuning does for its gains too
        after = _After(desk, apply=args.apply, verify=args.verify)
        if is_simulated(backend):  # it ends with this program, so there is nothing to keep of it
            tuning, virtual = Tuning("shell", name, request), not args.real_time
            work = _conduct(tuning, loop, backend, after, virtual=virtual)
            _run(stoppable(work, partial(_abort, tuning)), virtual=virtual)
        else:
            tuning = Tuning(random_id(), name, request)
            action = f"autotuner tune {name}{after.option}"
            tell = partial(tell_earlier, configuration.service)
            begun = partial(note, configuration.service, action, BEGUN, name, tuning.id)
            try:
                work = _conduct_kept(tuning, loop, backend, after, journal, tell, begun)
                _run(stoppable(work, partial(_abort, tuning)), virtual=False)
            finally:
                keep(configuration.service, tuning)
        return max(_show(tuning, loop, desk, args), after.told())


command = TuneCommand()


def controller(text: str) -> dict[str, float]:
    """Return the gains of `--online` by name; raise `ValueError` for anything but one to three numbers."""
    names, parts = ("Kp", "Ti", "Td"), text.split(",")
    if len(parts) > len(names):
        raise ValueError(text)
    return {name: float(part) for name, part in zip(names, parts, strict=False)}


def _only(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    raise ConfigurationError("name the loop to tune", field="loop", remedy=f"Use one of {', '.join(names)}.")


def _run(work: Coroutine[object, object, None], *, virtual: bool) -> None:
    """Run on the wall clock, or in virtual time."""
    if virtual:
        import async_solipsism  # noqa: PLC0415 - only a simulated loop needs it

        factory = async_solipsism.EventLoop
    else:
        from autotuner.runtime.fine_loop import fine_event_loop as factory  # noqa: PLC0415 - keeps `--help` quick
    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(work)


class _After:
    """What is done with the gains of a tuning; refused before anything is moved where that cannot be done."""

    def __init__(self, desk: GainsDesk, *, apply: bool, verify: float | None) -> None:
        self._desk, self._apply, self._verify = desk, apply or verify is not None, verify
        self._trouble: AutotunerError | None = None
        self._code = 0
        if self._apply:
            desk.writer()

    @property
    def option(self) -> str:
        """How it was asked for at the shell."""
        return " --verify" if self._verify is not None else " --apply" if self._apply else ""

    async def do(self, tuning: Tuning, arithmetic: Arithmetic) -> None:
        """Do it; trouble is kept, because the result of the tuning is worth showing all the same."""
        if not (self._apply and tuning.succeeded):
            return
        try:
            run = await self._desk.use(tuning, None if self._verify is None else arithmetic, self._verify or None)
            self._code = 0 if run is None or run.passed else 1
        except AutotunerError as error:
            self._trouble = error

    def told(self) -> int:
        """Tell the trouble on standard error; return the exit code."""
        if self._trouble is None:
            return self._code
        sys.stderr.write(f"autotuner: {self._trouble}\n")
        return 1


async def _conduct_kept(
    tuning: Tuning,
    loop: LoopTable,
    backend: Backend,
    after: _After,
    journal: Journal,
    tell: Callable[[Kept, Earlier], None],
    begun: Callable[[], None],
) -> None:
    """Give back what a killed program left of this loop, then conduct a tuning that is kept on disk.

    A process stands by meanwhile, to give the loop back should this one be killed.
    """
    from autotuner.runtime.guardian import guard_here  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.runtime.recovery import recover_first  # noqa: PLC0415

    async with guard_here()(tuning.loop, loop, journal.folder):
        for kept, shown in await recover_first(tuning.loop, loop, backend, journal):
            tell(kept, shown)
        tuning.journal = journal.begin(tuning.head(loop.device_key))
        begun()
        await _conduct(tuning, loop, backend, after, virtual=False)


async def _conduct(tuning: Tuning, loop: LoopTable, backend: Backend, after: _After, *, virtual: bool) -> None:
    from autotuner.commands.progress import show_progress  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.runtime.arithmetic import InPlace, Workers  # noqa: PLC0415

    arithmetic = InPlace() if virtual else Workers()
    watcher = asyncio.create_task(show_progress(tuning, loop))
    try:
        await tuning.conduct(loop, backend, arithmetic)
        await watcher
        await after.do(tuning, arithmetic)
    finally:
        watcher.cancel()
        arithmetic.close()


def _abort(tuning: Tuning, number: signal.Signals) -> None:
    """End a tuning by a signal as an abort does: through the restore."""
    with contextlib.suppress(TuningStateError):  # it has just ended by itself
        tuning.abort(aborted("signal", f"stopped by {number.name}", "Start it again when wanted."))


def _show(tuning: Tuning, loop: LoopTable, desk: GainsDesk, args: argparse.Namespace) -> int:
    if args.recording is not None:
        args.recording.write_text(tuning.recording().to_csv(), encoding="utf-8")
    if args.picture is not None and tuning.analysis is not None:
        from autotuner.commands.picture import draw  # noqa: PLC0415 - matplotlib is slow to load

        draw(tuning.recording(), tuning.analysis.identification, args.picture, loop.pv_unit, loop.output_unit)
    if args.report is not None:
        from autotuner.commands.report import write_report  # noqa: PLC0415

        write_report(tuning, loop, desk, args.report)
    if args.json:
        sys.stdout.write(json.dumps(tuning.to_dict()) + "\n")
    else:
        from autotuner.commands.show import show_tuning  # noqa: PLC0415

        show_tuning(tuning, loop, args.picture)
    return 0 if tuning.succeeded else 1
