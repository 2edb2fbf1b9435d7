"""`autotuner reproduce`: published results remade, beside what was printed and beside the truth."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner_models.methods import methods_table, noisy_methods_table, remade_by_methods
from autotuner_models.offline_exact import bias_table, exact_table
from autotuner_models.online import online_table
from autotuner_models.thesis.comparison_figures import (
    error_figures,
    literature_figures,
    offline_figures,
    percent_figures,
    proposed_figures,
)
from autotuner_models.thesis.data_figures import data_figures
from autotuner_models.thesis.draws import predicted, score_figures
from autotuner_models.thesis.examples import examples_table
from autotuner_models.thesis.learned_table import honest_table, r2_table
from autotuner_models.thesis.marks import marks_table, summary_table
from autotuner_models.thesis.pictures import write_pictures

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from autotuner_models.report import ReportTable
    from autotuner_models.thesis.marks import Figure


PIPE_WIDTH = 180
"""Width of the tables without a terminal, characters."""
REPORT = Path("thesis.html")
"""Default file of the report of all parts."""


@cache
def stated_figures() -> list[Figure]:
    """Return the printed figures that need no learning and no other method."""
    return [*offline_figures(), *error_figures(), *percent_figures(), *data_figures()]


@cache
def learned_figures() -> list[Figure]:
    """Return the printed figures of the thesis's regressors."""
    return [*score_figures(), *proposed_figures(predicted())]


@cache
def method_figures() -> list[Figure]:
    """Return the printed figures of the literature's methods."""
    return literature_figures(remade_by_methods())


def stated_table() -> ReportTable:
    """Return the marks of the "Offline" rows, of all errors, and of the training data."""
    return marks_table("stated", "Figures that follow from the thesis itself: formulas, errors, data", stated_figures())


def learned_marks_table() -> ReportTable:
    """Return the marks of table 5.1 and of the "Proposed" rows."""
    return marks_table("proposed", "Figures of the thesis's regressors", learned_figures())


def method_marks_table() -> ReportTable:
    """Return the marks of the literature's rows."""
    return marks_table("literature", "Figures of the literature's rows", method_figures())


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a study, selected by its own option."""

    help: str
    tables: tuple[Callable[[], ReportTable], ...]


PARTS: dict[str, Part] = {
    "offline": Part(
        "the marks of the describing-function rows, errors and data of all tables, and the bias behind them",
        (stated_table, exact_table, bias_table),
    ),
    "online": Part("the row of table 2.1 with a controller beside the relay", (online_table,)),
    "learned": Part(
        "table 5.1 and examples 1-6: the thesis's regressors on their grid, off it and out of range, and ours",
        (learned_marks_table, r2_table, honest_table, examples_table),
    ),
    "methods": Part(
        "all tables by every method of the literature, without and with noise",
        (method_marks_table, methods_table, noisy_methods_table),
    ),
}
"""Option name to part; without any option all are done."""


@dataclass(frozen=True, slots=True)
class ReproduceCommand:
    """Remake published results."""

    help: str = "Remake the thesis's tables and figures beside the printed ones."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("study", choices=["thesis"], help="what to remake")
        for name, part in PARTS.items():
            parser.add_argument(f"--{name}", action="store_true", help=part.help)
        parser.add_argument(
            "--pictures", type=Path, metavar="DIR", help="write figures 1.2, 3.1, 4.1, 4.2, 5.1-5.16 there"
        )
        parser.add_argument(
            "--report", type=Path, metavar="FILE", help=f"HTML report of everything (default {REPORT} without a part)"
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        parser.epilog = (
            "examples:\n  autotuner reproduce thesis --report thesis.html\n"
            "  autotuner reproduce thesis --pictures figures"
        )

    def run(self, args: argparse.Namespace) -> int:
        """Compute and print; 1 when a figure that must agree does not."""
        if args.pictures is not None:
            write_pictures(args.pictures)
        selected = [name for name in PARTS if getattr(args, name)]
        tables = [table() for name in selected or PARTS for table in PARTS[name].tables]
        report = args.report or (None if selected or args.json else REPORT)
        if not selected:
            tables.insert(0, summary_table(all_figures()))
        if args.json:
            sys.stdout.write(json.dumps({table.key: table.to_dict() for table in tables}) + "\n")
        else:
            _print(tables)
        if report is not None:
            _write_report(report, tables)
        failures = [failure for table in tables for failure in table.failures]
        for failure in failures:
            sys.stderr.write(f"autotuner: not reproduced: {failure}\n")
        return 1 if failures else 0


command = ReproduceCommand()


def all_figures() -> list[Figure]:
    """Return every figure that the thesis's tables print, with its mark, table by table."""
    return sorted(
        (*stated_figures(), *learned_figures(), *method_figures()), key=lambda f: [int(n) for n in f.table.split(".")]
    )


def _write_report(path: Path, tables: list[ReportTable]) -> None:
    from autotuner_models.thesis_report import thesis_report  # noqa: PLC0415 - not needed for tables

    figures = all_figures()
    behind = [table for table in tables if table.key not in {"summary", "stated", "proposed", "literature"}]
    path.write_text(thesis_report(figures, summary_table(figures), behind), encoding="utf-8")
    sys.stderr.write(f"autotuner: report: {path}\n")


def _print(tables: list[ReportTable]) -> None:
    from rich.console import Console  # noqa: PLC0415 - not needed for JSON

    console = Console(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
    for table in tables:
        console.print(table.to_rich())
        console.print()
