"""`autotuner reproduce`: published results remade, beside what was printed and beside the truth."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner_models.methods import methods_table, noisy_methods_table
from autotuner_models.offline_exact import bias_table, exact_table
from autotuner_models.offline_stated import stated_table
from autotuner_models.online import online_table
from autotuner_models.thesis.examples import examples_table
from autotuner_models.thesis.learned_table import honest_table, r2_table
from autotuner_models.thesis.pictures import write_pictures

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from autotuner_models.report import ReportTable


PIPE_WIDTH = 180
"""Columns for the tables where there is no terminal to ask."""


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a study, asked for by its own option."""

    help: str
    tables: tuple[Callable[[], ReportTable], ...]


PARTS: dict[str, Part] = {
    "offline": Part(
        "the describing-function rows of tables 2.1-2.3 and 5.2-5.7, and the bias behind them",
        (stated_table, exact_table, bias_table),
    ),
    "online": Part("the row of table 2.1 with a controller beside the relay", (online_table,)),
    "learned": Part(
        "table 5.1 and examples 1-6: the thesis's regressors on their grid, off it and out of range, and ours",
        (r2_table, honest_table, examples_table),
    ),
    "methods": Part(
        "all tables by every method of the literature, without and with noise", (methods_table, noisy_methods_table)
    ),
}
"""Option name to part; without any option all are done."""


@dataclass(frozen=True, slots=True)
class ReproduceCommand:
    """Remake published results."""

    help: str = "Remake the thesis's tables and print ours beside theirs and the truth."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("study", choices=["thesis"], help="what to remake")
        for name, part in PARTS.items():
            parser.add_argument(f"--{name}", action="store_true", help=part.help)
        parser.add_argument("--pictures", type=Path, metavar="DIR", help="write figures 5.1-5.16 there")
        parser.add_argument("--json", action="store_true", help="print one JSON object")

    def run(self, args: argparse.Namespace) -> int:
        """Compute and print; 1 when a figure that must agree does not."""
        if args.pictures is not None:
            write_pictures(args.pictures)
        wanted = [name for name in PARTS if getattr(args, name)] or list(PARTS)
        tables = [table() for name in wanted for table in PARTS[name].tables]
        if args.json:
            sys.stdout.write(json.dumps({table.key: table.to_dict() for table in tables}) + "\n")
        else:
            _print(tables)
        failures = [failure for table in tables for failure in table.failures]
        for failure in failures:
            sys.stderr.write(f"not reproduced: {failure}\n")
        return 1 if failures else 0


command = ReproduceCommand()


def _print(tables: list[ReportTable]) -> None:
    from rich.console import Console  # noqa: PLC0415 - not needed for JSON

    console = Console(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
    for table in tables:
        console.print(table.to_rich())
        console.print()
