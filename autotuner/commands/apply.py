"""`autotuner apply` and `autotuner rollback`: gains into the device of a loop, and back."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from autotuner.commands.files.audit_trail import audited, report_earlier
from autotuner.commands.files.configured import add_configuration, configuration_of, journal_of
from autotuner.commands.terminal.output import show, writing
from autotuner.commands.terminal.stopping import Stop
from autotuner.commands.terminal.usage import add_examples
from autotuner.errors import InputError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Coroutine

    from autotuner.application.gain_service import GainService
    from autotuner.application.loop_processes import LoopProcesses
    from autotuner.configuration import Configuration, LoopTable, ServiceTable
    from autotuner.control.gains.apply import Applied
    from autotuner.control.records.journal import Journal
    from autotuner.core.design import PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.ports import Backend

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ApplyCommand:
    """Write gains."""

    help: str = (
        "Write gains into the device of a loop and read them back; the old ones are kept for `autotuner rollback`."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        _add_loop(parser)
        source = parser.add_mutually_exclusive_group(required=True)
        source.add_argument(
            "--from", dest="result", type=Path, metavar="FILE", help="result of `autotuner tune --json`"
        )
        source.add_argument("--gains", metavar="KP,TI,TD", help="ideal form, times in s; TI and TD may be left out")
        parser.add_argument("--dry-run", action="store_true", help="show the values without writing them")
        parser.add_argument(
            "--force", action="store_true", help="also when the device's gains changed since the tuning"
        )
        add_examples(
            parser,
            "autotuner apply TIC-101 --from result.json --dry-run",
            "autotuner apply TIC-101 --gains 1.2,8,0.5 --config loops.toml",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Write the gains, or show them."""
        configuration = configuration_of(args)
        device = _device_of(configuration, args.loop)
        source = _by_hand(args.gains) if args.result is None else _of_file(args.result, args.loop)
        if args.dry_run:
            _print(asyncio.run(_planned(device.gain_service, source)), args, "would be written")
            return 0
        expected = None if args.force else source.expected
        with audited(configuration.service, f"autotuner apply {args.loop}", args.loop, source.tuning or None):
            stop = Stop()
            work = _written(device, source, expected, configuration.service, stop)
            applied = asyncio.run(stop.over(_closing(device, work)))
        _print(applied.to_dict(), args, "written and read back")
        return 0


@dataclass(frozen=True, slots=True)
class RollbackCommand:
    """Put gains back."""

    help: str = "Put the gains back that the device of a loop had before the latest `autotuner apply`."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        _add_loop(parser)
        parser.add_argument("--force", action="store_true", help="overwrite gains that were changed by others")
        add_examples(parser, "autotuner rollback TIC-101", "autotuner rollback TIC-101 --config loops.toml --force")

    def run(self, args: argparse.Namespace) -> int:
        """Put them back."""
        configuration = configuration_of(args)
        device = _device_of(configuration, args.loop)
        with audited(configuration.service, f"autotuner rollback {args.loop}", args.loop):
            back = asyncio.run(Stop().over(_closing(device, device.gain_service.roll_back(force=args.force)))).to_dict()
        _print({**back, "old": back["was"]}, args, "restored and read back", only=tuple(back))
        return 0


command = ApplyCommand()


@dataclass(frozen=True, slots=True)
class _Source:
    """Gains and their origin."""

    gains: PidGains
    tuning: str = ""
    model: ProcessModel | None = None
    expected: dict[str, float] | None = field(default=None)


@dataclass(frozen=True, slots=True)
class _Device:
    """A loop with its device, and where its gains are written."""

    name: str
    loop: LoopTable
    backend: Backend
    journal: Journal
    processes: LoopProcesses | None
    gain_service: GainService


def _add_loop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("loop", help="the loop's name")
    add_configuration(parser)
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _device_of(configuration: Configuration, name: str) -> _Device:
    """Return the device of a loop.

    Raises
    ------
    InputError
        Unknown loop, or one that is simulated: its device ends with this program.
    """
    from autotuner.application.gain_service import GainService  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.application.loop_processes import loop_processes  # noqa: PLC0415
    from autotuner.control.devices.plugins import is_simulated, make_backend  # noqa: PLC0415

    loop = configuration.loop(name)
    backend = make_backend(loop.driver, loop.device, f"loops.{name}")
    if is_simulated(backend):
        raise InputError(
            "is simulated: its device lives only as long as this program",
            field="loop",
            value=name,
            remedy="Use `autotuner tune --apply`, or `autotuner serve`.",
        )
    journal, processes = journal_of(configuration), loop_processes()
    return _Device(name, loop, backend, journal, processes, GainService(name, loop, backend, journal, processes))


async def _closing(device: _Device, work: Coroutine[object, object, T]) -> T:
    """Do `work`, then end the loop process."""
    from autotuner.control.devices.retrying import to_its_end  # noqa: PLC0415 - keeps `--help` quick

    try:
        return await work
    finally:
        if device.processes is not None:
            await to_its_end(device.processes.close())


async def _written(
    device: _Device, source: _Source, expected: dict[str, float] | None, service: ServiceTable, stop: Stop
) -> Applied:
    """Recover the loop from an interrupted run, then write gains."""
    from autotuner.application.recovery import recover_first  # noqa: PLC0415 - keeps `--help` quick
    from autotuner.control.devices.retrying import to_its_end  # noqa: PLC0415

    work = recover_first(device.name, device.loop, device.backend, device.journal, device.processes)
    for record, earlier_run in await to_its_end(work):
        report_earlier(service, record, earlier_run)
    stop.check()
    return await device.gain_service.write(source.gains, tuning=source.tuning, model=source.model, expected=expected)


def _by_hand(text: str) -> _Source:
    from autotuner.core.design import PidGains  # noqa: PLC0415 - brings SciPy with it

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3:
        raise InputError(
            "is not one to three numbers", field="--gains", value=text, remedy="Write KP,TI,TD, such as 1.2,8,0.5."
        )
    return _Source(PidGains(*numbers))


def _of_file(file: Path, loop: str) -> _Source:
    """Return the gains of a result; raise `InputError` when it is of another loop, or has none."""
    from autotuner.core.design import gains_from_dict  # noqa: PLC0415 - brings SciPy with it
    from autotuner.core.model.process import model_from_dict  # noqa: PLC0415

    result = _read(file)
    if result.get("loop", loop) != loop:
        raise InputError(
            f"is the result of loop {result['loop']}", field="--from", value=str(file), remedy=f"Not of {loop}."
        )
    model = result.get("model")
    return _Source(
        gains_from_dict(result["gains"]),
        str(result.get("id", "")),
        model_from_dict(model, result.get("structure")) if isinstance(model, dict) else None,
        result.get("device_gains"),
    )


def _read(file: Path) -> dict[str, Any]:
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot be read: {error}", field="--from", value=str(file), remedy="Check the path."
        ) from error
    if not isinstance(result, dict) or not isinstance(result.get("gains"), dict):
        raise InputError(
            "has no gains",
            field="--from",
            value=str(file),
            remedy="Give the file that `autotuner tune --json` wrote of a tuning that ended as done.",
        )
    return result


async def _planned(gain_service: GainService, source: _Source) -> dict[str, Any]:
    """Return the preview of an apply."""
    planned, present = gain_service.planned(source.gains, source.model), await gain_service.read()
    return {
        "loop": present["loop"],
        "old": {"values": present["values"], "gains": present["gains"]},
        "now": {"values": planned.values, "gains": planned.held.gains.to_dict()},
        "form": planned.held.form,
        **planned.held.device.action.to_dict(),
        "margins": planned.held.margins.to_dict() if planned.held.margins else None,
        "warnings": list(planned.held.warnings),
    }


def _print(audited: dict[str, Any], args: argparse.Namespace, what: str, only: tuple[str, ...] | None = None) -> None:
    if args.json:
        show(json.dumps(audited if only is None else {name: audited[name] for name in only}) + "\n")
        return
    from autotuner.commands.terminal.show import results_console, show_device_gains  # noqa: PLC0415

    with writing():
        show_device_gains(results_console(), audited, what)
