"""`autotuner gains`: gains for a given model."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.core.process import ProcessModel, model_from_dict
from autotuner.errors import InputError

if TYPE_CHECKING:
    import argparse


@dataclass(frozen=True, slots=True)
class GainsCommand:
    """Tune a model."""

    help: str = "Compute gains for a process model, by goal or by a tuning rule."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "--model",
            metavar="JSON",
            help='the model as JSON, such as {"K": 2, "T": 10, "D": 1.5}, or a file holding it or a result',
        )
        parser.add_argument("--goal", default="balanced", help="calm, balanced or brisk")
        parser.add_argument("--rule", help="a rule of the table instead of a goal")
        parser.add_argument("--rules", action="store_true", help="list the rules and exit")
        parser.add_argument("--json", action="store_true", help="print one JSON object")

    def run(self, args: argparse.Namespace) -> int:
        """Compute and show."""
        from autotuner.core.tuning import rule_names, tune  # noqa: PLC0415 - keeps `--help` quick

        if args.rules:
            sys.stdout.write("\n".join(rule_names()) + "\n")
            return 0
        if args.model is None:
            raise InputError(
                "is missing", field="--model", remedy='Give it as JSON: --model \'{"K": 2, "T": 10, "D": 1.5}\'.'
            )
        result = tune(read_model(args.model), goal=args.goal, rule=args.rule)
        if args.json:
            sys.stdout.write(json.dumps(result.to_dict()) + "\n")
            return 0
        from autotuner.commands.show import results_console, show_gains  # noqa: PLC0415

        console = results_console()
        show_gains(console, result)
        for warning in result.warnings:
            console.print(f"[yellow]warning:[/yellow] {warning}")
        return 0


command = GainsCommand()


def read_model(text: str) -> ProcessModel:
    """Return the model of a JSON text or file; a result of `identify` or `tune` counts by its `model`.

    Raises
    ------
    InputError
        No JSON, no object, or no possible model; names the field.
    """
    source = text if text.lstrip().startswith("{") else _content(Path(text))
    try:
        values = json.loads(source)
    except json.JSONDecodeError as error:
        raise InputError(
            f"is no JSON: {error}", field="--model", value=text, remedy="Quote it for the shell."
        ) from error
    if not isinstance(values, dict):
        raise InputError("is no JSON object", field="--model", value=text, remedy='Write {"K": 2, "T": 10, "D": 1.5}.')
    structure = values.get("structure")
    inner = values.get("model")
    return model_from_dict(inner if isinstance(inner, dict) else values, structure if inner is not None else None)


def _content(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"is neither a JSON object nor a readable file: {error}",
            field="--model",
            value=str(file),
            remedy="Check the path.",
        ) from error
