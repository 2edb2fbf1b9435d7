"""`autotuner tune`: one tuning from the shell, with live progress.

A loop whose driver says that it is simulated runs in virtual time unless `--real-time` is given: the same code on an
event loop whose time jumps to the next deadline.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.configuration import load_configuration
from autotuner.core.verdict import aborted
from autotuner.errors import ConfigurationError, TuningStateError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Coroutine

    from autotuner.configuration import LoopTable
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend
    from autotuner.runtime.journal import Journal
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


STOPPED_BY = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


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
        parser.add_argument("--goal", default="balanced", help="goal of the gains: calm, balanced, brisk")
        parser.add_argument("--rule", help="a tuning rule by name instead of a goal")
        parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
        parser.add_argument("--picture", type=Path, metavar="FILE", help="draw measured and model to a PNG, SVG or PDF")
        parser.add_argument("--recording", type=Path, metavar="FILE", help="write the recording as CSV")
        parser.add_argument("--real-time", action="store_true", help="run a simulated loop on the wall clock too")

    def run(self, args: argparse.Namespace) -> int:
        """Tune and show the result."""
        from autotuner.runtime.journal import Journal  # noqa: PLC0415 - keeps `--help` quick
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
        request = TuningRequest(loop.experiment_settings(**overrides), args.structure, args.goal, args.rule)
        backend = make_backend(loop.driver, loop.device, f"loops.{name}")
        if is_simulated(backend):
            tuning, virtual = Tuning("shell", name, request), not args.real_time
            _run(_conduct(tuning, loop, backend, virtual=virtual), virtual=virtual)
        else:
            tuning, journal = Tuning(random_id(), name, request), Journal(Path(configuration.service.data_directory))
            _run(_conduct_kept(tuning, loop, backend, journal), virtual=False)
        return _show(tuning, loop, args)


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
    if not virtual:
        asyncio.run(work)
        return
    import async_solipsism  # noqa: PLC0415 - only a simulated loop needs it

    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(work)


async def _conduct_kept(tuning: Tuning, loop: LoopTable, backend: Backend, journal: Journal) -> None:
    """Give back what a killed program left of this loop, then conduct a tuning that is kept on disk."""
    from autotuner.runtime.recovery import recover_first  # noqa: PLC0415 - keeps `--help` quick

    _abort_on_signals(tuning)
    for verdict in await recover_first(tuning.loop, loop, backend, journal):
        sys.stderr.write(f"earlier tuning of {tuning.loop}: {verdict.message}\n")
    tuning.journal = journal.begin(tuning.head(loop.device_key))
    await _conduct(tuning, loop, backend, virtual=False)


async def _conduct(tuning: Tuning, loop: LoopTable, backend: Backend, *, virtual: bool) -> None:
    from autotuner.commands.progress import show_progress  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.runtime.arithmetic import InPlace, Workers  # noqa: PLC0415

    arithmetic = InPlace() if virtual else Workers()
    _abort_on_signals(tuning)
    watcher = asyncio.create_task(show_progress(tuning, loop))
    try:
        await tuning.conduct(loop, backend, arithmetic)
        await watcher
    finally:
        watcher.cancel()
        arithmetic.close()


def _abort_on_signals(tuning: Tuning) -> None:
    """Let a signal, that of a closed terminal too, end the tuning as an abort does: through the restore."""
    for number in STOPPED_BY:
        verdict = aborted("signal", f"stopped by {number.name}", "Start it again when wanted.")
        with contextlib.suppress(NotImplementedError, RuntimeError):  # virtual time and Windows have no signal handlers
            asyncio.get_running_loop().add_signal_handler(number, _abort, tuning, verdict)


def _abort(tuning: Tuning, verdict: Verdict) -> None:
    with contextlib.suppress(TuningStateError):  # it has just ended by itself
        tuning.abort(verdict)


def _show(tuning: Tuning, loop: LoopTable, args: argparse.Namespace) -> int:
    if args.recording is not None:
        args.recording.write_text(tuning.recording().to_csv(), encoding="utf-8")
    if args.picture is not None and tuning.analysis is not None:
        from autotuner.commands.picture import draw  # noqa: PLC0415 - matplotlib is slow to load

        draw(tuning.recording(), tuning.analysis.identification, args.picture, loop.pv_unit, loop.output_unit)
    if args.json:
        sys.stdout.write(json.dumps(tuning.to_dict()) + "\n")
    else:
        from autotuner.commands.show import show_tuning  # noqa: PLC0415

        show_tuning(tuning, loop, args.picture)
    return 0 if tuning.succeeded else 1
