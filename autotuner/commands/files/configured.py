"""The options of every command that reads a configuration and uses its state, and interrupted runs in that state."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import say
from autotuner.configuration import load_configuration
from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    import argparse

    from autotuner.configuration import Configuration, LoopTable
    from autotuner.control.records.journal import Journal

CONFIGURATION = "TOML file of loops (default: autotuner.toml)"


def add_configuration(parser: argparse.ArgumentParser, text: str = CONFIGURATION) -> None:
    """Add `--config` and `--data-directory`."""
    parser.add_argument("--config", type=Path, metavar="FILE", help=text)
    add_data_directory(parser)


def add_data_directory(parser: argparse.ArgumentParser) -> None:
    """Add `--data-directory`."""
    parser.add_argument(
        "--data-directory",
        type=Path,
        metavar="FOLDER",
        help="where leases, gains and the history are kept (default: service.data_directory, else the state directory "
        "of the platform)",
    )


def configuration_of(args: argparse.Namespace) -> Configuration:
    """Return the configuration that the options name."""
    return load_configuration(args.config).keeping_state_in(args.data_directory)


def journal_of(configuration: Configuration) -> Journal:
    """Return the leases of a configuration's data directory."""
    from autotuner.control.records.journal import Journal  # noqa: PLC0415 - keeps `--help` quick

    return Journal(Path(configuration.service.data_directory))


def report_left(journal: Journal, name: str, loop: LoopTable) -> None:
    """Report an interrupted run of a loop on standard error."""
    if (unresolved := journal.unresolved(name, loop.device_key)) is not None:
        from autotuner.errors import OutputUnknownError  # noqa: PLC0415 - keeps `--help` quick

        say(OutputUnknownError(name, unresolved.name, unresolved.why))
    for kept in journal.left(name):
        held = journal.is_held(kept)
        state = "runs in another program" if held else "was interrupted; the next start restores the loop"
        say(f"{name}: {kept.kind} {kept.tuning} of {kept.started_at} {state}")


def report_left_of(args: argparse.Namespace) -> None:
    """Report interrupted runs of the loop that a command of another package, such as `probe`, uses."""
    if "://" in (args.loop or ""):
        return
    with contextlib.suppress(ConfigurationError):  # such a command needs less of a file than a tuning does
        configuration = configuration_of(args)
        names = [args.loop] if args.loop else list(configuration.loops)
        loop = configuration.loops.get(names[0]) if len(names) == 1 else None
        if loop is not None:
            report_left(journal_of(configuration), names[0], loop)
