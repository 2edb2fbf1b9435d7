"""`autotuner bench`: the benchmarks by name, where a checkout of the repository is there."""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import autotuner
from autotuner.commands.terminal.output import show
from autotuner.commands.terminal.usage import add_examples, suggestion
from autotuner.errors import InputError

FOLDER = Path(autotuner.__file__).parents[1] / "benchmarks"


@dataclass(frozen=True, slots=True)
class BenchCommand:
    """Run one benchmark in its own process."""

    help: str = "Run a benchmark by name; without a name, list them. They are part of the repository, not of the wheel."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("name", nargs="?", help="which benchmark")
        parser.add_argument(
            "arguments", nargs=argparse.REMAINDER, metavar="...", help="its own arguments; --help after the name"
        )
        add_examples(parser, "autotuner bench", "autotuner bench identification --help")

    def run(self, args: argparse.Namespace) -> int:
        """Run or list; the exit code is the benchmark's."""
        files = benchmarks(FOLDER)
        if args.name is None:
            show("".join(f"{name:16} {summary(file)}\n" for name, file in files.items()))
            return 0
        if args.name not in files:
            raise InputError("is not a benchmark", field="bench", value=args.name, remedy=suggestion(args.name, files))
        command = [sys.executable, str(files[args.name]), *args.arguments]
        return subprocess.run(command, check=False).returncode  # noqa: S603 - our own files


command = BenchCommand()


def benchmarks(folder: Path) -> dict[str, Path]:
    """Return the benchmarks of a checkout by name.

    Raises
    ------
    InputError
        The benchmarks are missing: the tuner was not started from a checkout.
    """
    files = {file.stem: file for file in sorted(folder.rglob("*.py")) if not file.name.startswith("_")}
    runnable = {name: file for name, file in files.items() if "__main__" in file.read_text(encoding="utf-8")}
    if not runnable:
        raise InputError(
            "are not here: only a checkout of the repository holds them",
            field="benchmarks",
            value=str(folder),
            remedy="Run this command from a checkout, installed in place.",
        )
    return runnable


def summary(file: Path) -> str:
    """Return the first line of a benchmark's description."""
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
