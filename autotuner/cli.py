"""The shell command `autotuner`.

Rules of this file: a command is imported only when it is used, so that `--help` stays quick; every expected error
ends as one sentence with its remedy on standard error, and an exit code: 0 done, 1 failed with a reason, 2 wrong
usage.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from typing import TYPE_CHECKING

from autotuner.errors import AutotunerError, ConfigurationError, InputError, RecordingError, UnknownLoopError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.runtime.plugins import Command

COMMANDS: dict[str, str] = {
    "tune": "tune a loop: relay experiment, model, gains (the built-in simulated loop by default)",
    "apply": "write gains into the device of a loop, and read them back",
    "rollback": "put the gains back that a device had before",
    "serve": "run the REST service",
    "identify": "identify a process from CSV recordings",
    "diagnose": "name what a model lacks that a recording shows: friction, limits, lags, disturbances",
    "replay": "analyse an exported tuning again, and compare with what it told",
    "gains": "compute gains for a given model by goal or rule",
    "token": "make, list and revoke the tokens with which the service is reached",
    "check": "check a configuration without moving anything",
    "bench": "run a benchmark by name (in a checkout of the repository)",
}
"""The built-in commands: each is a module of `autotuner.commands` with a `command`."""

EXIT_CODES: dict[type[AutotunerError], int] = {
    ConfigurationError: 2,
    UnknownLoopError: 2,
    RecordingError: 1,
    InputError: 2,
    AutotunerError: 1,
}
"""Exit code by class of error; the first class that fits counts."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _run(arguments)
    except AutotunerError as error:
        sys.stderr.write(f"autotuner: {error}\n")
        return next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))
    except BrokenPipeError:  # the reader of a pipe has seen enough
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        sys.stderr.write("autotuner: interrupted\n")
        return 1


def _run(arguments: list[str]) -> int:
    name = next((word for word in arguments if not word.startswith("-")), None)
    parser = argparse.ArgumentParser(
        prog="autotuner",
        description="Tune a real control loop with a relay, and prove the model on measured data.",
        epilog="Each command has its own --help. Without a configuration a simulated loop is tuned.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    words = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    command = _add_commands(words, name)
    args = parser.parse_args(arguments)
    assert command is not None  # noqa: S101 - argparse has ended the program for a command that is not there
    return command.run(args)


def _add_commands(words: argparse._SubParsersAction[argparse.ArgumentParser], name: str | None) -> Command | None:
    """Announce all commands, load and configure only the one that is used."""
    from autotuner.runtime.plugins import COMMANDS as GROUP  # noqa: PLC0415 - only a real run pays for it
    from autotuner.runtime.plugins import announced  # noqa: PLC0415

    plugins = {plugin: point for plugin, point in announced(GROUP).items() if plugin not in COMMANDS}
    texts = COMMANDS | {plugin: f"from {_distribution(point)}" for plugin, point in plugins.items()}
    chosen: Command | None = None
    for word, text in texts.items():
        parser = words.add_parser(word, help=text, description=text)
        if word == name:
            chosen = plugins[word].load() if word in plugins else import_module(f"autotuner.commands.{word}").command
            parser.description = chosen.help
            chosen.configure(parser)
    return chosen


def _distribution(point: object) -> str:
    distribution = getattr(point, "dist", None)
    return distribution.name if distribution is not None else "a plug-in"


class _Version(argparse.Action):
    """Print the version of the installed distribution."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        from importlib.metadata import version  # noqa: PLC0415 - only this option needs it

        sys.stdout.write(f"autotuner {version('relay-autotuner')}\n")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
