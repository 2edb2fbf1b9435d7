"""`autotuner gains`: gains for a given model, or the pair of gains of a loop that was tuned on both sides of zero."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import show, writing
from autotuner.commands.terminal.usage import Number, add_examples
from autotuner.commands.tuning.design_options import add_design_options, design_spec_of
from autotuner.core.model.process import ProcessModel, model_from_dict
from autotuner.errors import InputError

if TYPE_CHECKING:
    import argparse

    from autotuner.core.design.gains import PidGains


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
        parser.add_argument(
            "--sample-time-s", type=Number(low=0.0), metavar="S", default=0.0, help="sample time of the controller, s"
        )
        parser.add_argument(
            "--noise",
            type=Number(low=0.0),
            help="standard deviation of the PV's noise, PV units, at that sample time",
        )
        add_design_options(parser)
        pair = parser.add_argument_group("heating and cooling")
        pair.add_argument(
            "--heat", metavar="FILE", help="result of `tune --side heat --json`, to be paired with --cool"
        )
        pair.add_argument("--cool", metavar="FILE", help="result of `tune --side cool --json`")
        pair.add_argument(
            "--hysteresis",
            type=Number(low=0.0),
            default=1.0,
            help="how far the output must pass zero to change the pair's gains",
        )
        parser.add_argument("--rules", action="store_true", help="list the rules and exit")
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        add_examples(
            parser,
            """autotuner gains --model '{"K": 2, "T": 10, "D": 1.5}' --goal calm""",
            "autotuner gains --model result.json --rule simc_pi",
            "autotuner gains --heat heat.json --cool cool.json",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Compute and show."""
        from autotuner.core.design import Basis, Noise, design_from_spec, rule_names, with_prediction  # noqa: PLC0415 - keeps `--help` quick

        if args.rules:
            show("\n".join(rule_names()) + "\n")
            return 0
        if args.heat is not None or args.cool is not None:
            return _show_pair(args)
        if args.model is None:
            raise InputError(
                "is missing", field="--model", remedy='Give it as JSON: --model \'{"K": 2, "T": 10, "D": 1.5}\'.'
            )
        noise = None if args.noise is None else Noise(args.noise, args.sample_time_s)
        basis = Basis(read_model(args.model), None, args.sample_time_s, noise)
        result = with_prediction(design_from_spec(basis, design_spec_of(args)), basis)
        if args.json:
            show(json.dumps(result.to_dict()) + "\n")
            return 0
        from autotuner.commands.terminal.show import results_console, show_chosen, show_gains, show_messages  # noqa: PLC0415

        with writing():
            console = results_console()
            show_messages(console, result.warnings, ())
            show_gains(console, result)
            show_chosen(console, result)
        return 0


command = GainsCommand()


def _show_pair(args: argparse.Namespace) -> int:
    """Print heating and cooling gains as one schedule over the output."""
    from autotuner.core.design.schedule import heat_cool  # noqa: PLC0415 - keeps `--help` quick

    heating, cooling = (_tuned_gains(getattr(args, side), side) for side in ("heat", "cool"))
    schedule = heat_cool(heating, cooling, args.hysteresis)
    if args.json:
        show(json.dumps(schedule.to_dict()) + "\n")
        return 0
    for side, gains in (("heating, output above", heating), ("cooling, output below", cooling)):
        show(f"{side} 0: {gains.words}\n")
    show(f"change over when the output has passed 0 by {schedule.hysteresis:g}\n")
    return 0


def _tuned_gains(file: str | None, side: str) -> PidGains:
    """Return the gains of a result of `tune --side`; raise `InputError` for anything else."""
    from autotuner.core.design.gains import gains_from_dict  # noqa: PLC0415

    if file is None:
        raise InputError("is missing", field=f"--{side}", remedy="Tune both sides, and give both results.")
    try:
        result = json.loads(_content(Path(file), f"--{side}"))
        tuned, gains = result["settings"]["side"], dict(result["gains"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            "holds no gains of a tuning",
            field=f"--{side}",
            value=file,
            remedy=f"Give the result of `autotuner tune --side {side} --json`.",
        ) from error
    if tuned != side:
        raise InputError("was not tuned on that side", field=f"--{side}", value=tuned, remedy="Swap the two files.")
    return gains_from_dict(gains)


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
            f"is not JSON: {error}", field="--model", value=text, remedy="Quote it for the shell."
        ) from error
    if not isinstance(values, dict):
        raise InputError("is no JSON object", field="--model", value=text, remedy='Write {"K": 2, "T": 10, "D": 1.5}.')
    structure = values.get("structure")
    inner = values.get("model")
    return model_from_dict(inner if isinstance(inner, dict) else values, structure if inner is not None else None)


def _content(file: Path, field: str = "--model") -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"is neither a JSON object nor a readable file: {error}",
            field=field,
            value=str(file),
            remedy="Check the path.",
        ) from error
