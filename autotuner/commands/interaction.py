"""`autotuner interaction`: interaction of two tuned loops, from the records of their tests."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.identify import parse_columns
from autotuner.commands.terminal.output import show, writing
from autotuner.commands.terminal.usage import Number, add_examples
from autotuner.commands.tuning.design_options import SMALLEST_MS, add_design_options, design_spec_of
from autotuner.core.recording import Recording

if TYPE_CHECKING:
    import argparse

    from rich.console import Console

    from autotuner.application.analysis.pair_analysis import PairAnalysis


@dataclass(frozen=True, slots=True)
class InteractionCommand:
    """Judge two loops together."""

    help: str = (
        "Relative gain of two loops, their margins with both in automatic, and gains that keep them: detuned, or with "
        "a decoupler. Each record is the test of one loop with the PV of the other, in manual, in a further column. A "
        "record in which both outputs moved serves as both: --columns and --other-output say which is which."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("first", type=Path, metavar="FIRST", help="CSV record of the first loop's test")
        parser.add_argument("second", type=Path, metavar="SECOND", help="CSV record of the second loop's test")
        parser.add_argument(
            "--other-pv",
            nargs=2,
            metavar=("NAME", "NAME"),
            default=(None, None),
            help="column of the other loop's PV in each record (default: the only further one)",
        )
        parser.add_argument(
            "--other-output",
            nargs=2,
            metavar=("NAME", "NAME"),
            default=(None, None),
            help="column of the other loop's output in each record, where it moved too (default: it did not)",
        )
        parser.add_argument(
            "--columns",
            nargs=2,
            metavar=("t=NAME,u=NAME,y=NAME", "t=NAME,u=NAME,y=NAME"),
            default=(None, None),
            help="which columns of each record are time, output and PV of its loop, by title or number from 1",
        )
        parser.add_argument(
            "--together-ms",
            type=Number(above=SMALLEST_MS),
            help="largest Ms and Mt with both loops in automatic (default: those of the goal)",
        )
        add_design_options(parser)
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        add_examples(
            parser,
            "autotuner interaction tic-101.csv tic-102.csv",
            "autotuner interaction a.csv b.csv --other-pv T2 T1 --together-ms 1.6 --json",
            "autotuner interaction both.csv both.csv --columns t=Time,u=Q1,y=T1 t=Time,u=Q2,y=T2 --other-output Q2 Q1",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Compute and show."""
        from autotuner.application.analysis.pair_analysis import analyse_pair  # noqa: PLC0415 - keeps `--help` quick

        first, second = (
            Recording.from_csv(file, parse_columns(columns))
            for file, columns in zip((args.first, args.second), args.columns, strict=True)
        )
        found = analyse_pair(
            (first, second), tuple(args.other_pv), design_spec_of(args), args.together_ms, tuple(args.other_output)
        )
        if args.json:
            show(json.dumps(found.to_dict()) + "\n")
            return 0
        from autotuner.commands.terminal.show import results_console  # noqa: PLC0415

        with writing():
            _print(results_console(), found)
        return 0


command = InteractionCommand()


def _print(console: Console, found: PairAnalysis) -> None:
    from autotuner.core.model.process import model_to_dict  # noqa: PLC0415

    pair = found.pair
    paths = {
        "first output, first PV": pair.first,
        "first output, second PV": pair.on_second,
        "second output, first PV": pair.on_first,
        "second output, second PV": pair.second,
    }
    for name, model in paths.items():
        values = {} if model is None else model_to_dict(model)
        text = " ".join(f"{key} {value:.4g}" for key, value in values.items() if not isinstance(value, str))
        console.print(f"{name:<26}{values.get('structure', 'no answer')}  {text}".rstrip(), soft_wrap=True)
    relative = found.interaction.relative_gain
    at_rest = "not defined (integrating)" if relative is None else f"{relative:.3f}"
    crossover = found.interaction.relative_gain_at_crossover
    console.print(f"relative gain             {at_rest} at rest, {crossover:.3f} at crossover")
    for name, one, gains in zip(("first loop", "second loop"), found.interaction.loops, pair.gains, strict=True):
        together = "unstable" if one.Ms is None or one.Mt is None else f"Ms {one.Ms:.2f}, Mt {one.Mt:.2f}"
        alone = f"Ms {one.Ms_alone:.2f}, Mt {one.Mt_alone:.2f}"
        console.print(f"{name:<26}alone {alone}; both in automatic {together}; {gains.words}", soft_wrap=True)
    for name, remedy in found.remedies.items():
        if isinstance(remedy, str):
            console.print(f"{name:<26}none: the pair {remedy}", soft_wrap=True)
            continue
        first, second = (gains.words for gains in remedy.gains)
        added = ""
        if remedy.decoupler is not None:
            added = f"; add {remedy.decoupler[0]:.4g} of the second controller's output to the first output and "
            added += f"{remedy.decoupler[1]:.4g} of the first's to the second"
        slower = f"slower by {remedy.detuning:.2f}, both in automatic Ms {remedy.interaction.worst:.2f}"
        console.print(f"{name:<26}{slower}: first {first}; second {second}{added}", soft_wrap=True)
    console.print(f"[bold]{found.advice}[/bold]", soft_wrap=True)
