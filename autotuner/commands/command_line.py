"""The commands of the shell by name, and the parser of their options.

Invariant: a command is imported only when it is used, so that `--help` stays quick.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from typing import TYPE_CHECKING

from autotuner.commands.terminal.usage import Parser, add_examples, suggestion
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.control.devices.plugins import Command

COMMANDS: dict[str, str] = {
    "tune": "tune a loop: relay experiment, model, gains (the built-in simulated loop by default)",
    "apply": "write gains into the device of a loop, and read them back",
    "rollback": "put the gains back that a device had before",
    "serve": "run the REST service",
    "identify": "identify a process from CSV recordings",
    "diagnose": "find effects that a recording shows and a model lacks: friction, limits, lags, disturbances",
    "replay": "analyse an exported tuning again, and compare the results",
    "gains": "compute gains for a given model by goal or rule",
    "interaction": "judge two loops that disturb each other, from the records of their tests",
    "token": "make, list and revoke the tokens with which the service is reached",
    "check": "check a configuration without moving anything",
    "bench": "run a benchmark by name (in a checkout of the repository)",
    "completion": "print the completion script of a shell: bash, zsh or fish",
}
"""The built-in commands: each is a module of `autotuner.commands` with a `command`."""
TEXTS: dict[str, str] = {
    "conformance": "check a driver against the rules that every driver keeps",
    "plc": "serve a simulated plant as a Modbus slave or a serial board",
    "probe": "read a loop's device without moving anything: values, times, possible sample time",
    "reproduce": "remake the thesis's tables and figures beside the printed ones",
    "train": "train the learned correction on simulated experiments",
}
"""Summaries of commands from other packages: loading one for its summary takes longer than all other help."""


def command_line(name: str | None, *, whole: bool = False) -> tuple[Parser, Command | None]:
    """Return the parser, and the command `name`.

    Parameters
    ----------
    name : str or None
        The command that is used: only its options are known.
    whole : bool
        Whether the options of all commands are known.

    Raises
    ------
    InputError
        There is no such command.
    """
    plugins = _plugins()
    if name is not None and name not in COMMANDS | plugins:
        raise InputError("is no command", field="autotuner", value=name, remedy=suggestion(name, COMMANDS | plugins))
    parser = Parser(
        prog="autotuner",
        description="Tune a real control loop with a relay, and prove the model on measured data.",
    )
    add_examples(parser, "autotuner tune", "autotuner tune TIC-101 --config loops.toml --verify", "autotuner serve")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    below = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    chosen = None
    for word in COMMANDS | plugins:
        command = _load(word, plugins) if whole or word == name else None
        text = COMMANDS.get(word) or TEXTS.get(word) or "from another package"
        one = below.add_parser(word, help=text, description=command.help if command else text)
        if command is not None:
            command.configure(one)
            if word in plugins and "--config" in one.format_usage():
                _add_data_directory(one)
        chosen = command if word == name else chosen
    return parser, chosen


def _add_data_directory(parser: argparse.ArgumentParser) -> None:
    from autotuner.commands.files.configured import add_data_directory  # noqa: PLC0415 - keeps `--help` quick

    add_data_directory(parser)


def _plugins() -> dict[str, object]:
    """Return the commands that other packages announce."""
    from autotuner.control.devices.plugins import COMMANDS as GROUP  # noqa: PLC0415 - only a real run pays for it
    from autotuner.control.devices.plugins import announced  # noqa: PLC0415

    return {name: point for name, point in announced(GROUP).items() if name not in COMMANDS}


def _load(word: str, plugins: dict[str, object]) -> Command:
    if word not in plugins:
        built_in: Command = import_module(f"autotuner.commands.{word}").command
        return built_in
    plugin: Command = plugins[word].load()  # type: ignore[attr-defined]
    return plugin


class _Version(argparse.Action):
    """Print the version of the installed distribution."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        from importlib.metadata import version  # noqa: PLC0415 - only this option needs it

        sys.stdout.write(f"autotuner {version('relay-autotuner')}\n")
        parser.exit()
