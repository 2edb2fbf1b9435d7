"""`autotuner tune`: one tuning from the shell, with live progress.

A simulated loop runs in virtual time unless `--real-time` is given: the same code on an
event loop whose time jumps to the next deadline.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.files.configured import add_configuration, configuration_of
from autotuner.commands.files.result_files import PICTURES, check_writable
from autotuner.commands.terminal.usage import Number, UnusableValueError, add_examples, words
from autotuner.commands.tuning.design_options import add_budget, add_design_options, add_structure
from autotuner.commands.tuning.one_tuning import RELAY_OPTIONS, OneTuning

if TYPE_CHECKING:
    import argparse

    from autotuner.commands.tuning.cascade import CascadeTuning


@dataclass(frozen=True, slots=True)
class TuneCommand:
    """Tune one loop."""

    help: str = (
        "Tune a loop: relay experiment, model with its errors, gains. Without arguments a simulated loop is tuned."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("loop", nargs="?", help="the loop's name; may be left out when there is only one")
        add_configuration(parser, "TOML file of loops (default: autotuner.toml, else a demo loop)")
        parser.add_argument(
            "--cascade", metavar="OUTER", help="tune LOOP, write its gains and close it, then tune OUTER through it"
        )
        parser.add_argument("--real-time", action="store_true", help="run a simulated loop on the wall clock too")
        _add_experiment(parser.add_argument_group("experiment"))
        model = parser.add_argument_group("model")
        add_structure(model)
        add_budget(model, "of the analysis")
        add_design_options(parser)
        _add_device(parser.add_argument_group("device"))
        _add_results(parser.add_argument_group("results"))
        add_examples(
            parser,
            "autotuner tune",
            "autotuner tune TIC-101 --config loops.toml --goal calm --verify",
            "autotuner tune FIC-7 --cascade TIC-7 --config loops.toml",
            "autotuner tune TIC-101 --amplitude 5 --report tic-101.html --recording tic-101.csv",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Tune and show the result."""
        configuration = configuration_of(args)
        if configuration.learned.artefacts is not None:
            from autotuner.application.analysis.learned import use_artefacts  # noqa: PLC0415 - brings SciPy with it

            use_artefacts(configuration.learned.artefacts)
        _check_files(args)
        run: OneTuning | CascadeTuning
        if args.cascade is None:
            run = OneTuning(configuration, args)
        else:
            from autotuner.commands.tuning.cascade import CascadeTuning  # noqa: PLC0415 - few need it

            run = CascadeTuning(configuration, args)
        run.conduct()
        return run.show()


def _add_experiment(group: argparse._ArgumentGroup) -> None:
    for name, (kind, text) in RELAY_OPTIONS.items():
        group.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar=name.rpartition("_")[2].upper(), help=text)
    group.add_argument(
        "--online",
        type=controller,
        metavar="KP,TI,TD",
        help="run this controller in parallel with the relay: ideal form, times in s; without TD no derivative, "
        "without TI no integral action",
    )
    group.add_argument(
        "--side", type=words("heat", "cool"), metavar="{heat,cool}", help="side of output zero on which the relay stays"
    )
    group.add_argument(
        "--drift-compensation", action="store_true", help="follow a PV that drifts at rest, instead of refusing it"
    )
    group.add_argument("--no-check", action="store_true", help="leave out the check after the relay")


def _add_device(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--apply", action="store_true", help="write the gains into the device, and read them back")
    group.add_argument(
        "--verify",
        nargs="?",
        type=Number(),
        const=0.0,
        metavar="STEP",
        help="write the gains, then make a small set-point step (STEP, PV units) under them: the old gains are "
        "restored unless the loop follows the prediction",
    )


def _add_results(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--json", action="store_true", help="print the result as one JSON object")
    group.add_argument("--picture", type=Path, metavar="FILE", help="draw measured and model to a PNG, SVG or PDF")
    group.add_argument("--report", type=Path, metavar="FILE", help="write everything as one HTML file")
    group.add_argument("--recording", type=Path, metavar="FILE", help="write the recording as CSV")
    group.add_argument(
        "--also-record",
        metavar="LOOP",
        help="read the PV of another loop, which is in manual, into the recording (see `autotuner interaction`)",
    )


def _check_files(args: argparse.Namespace) -> None:
    """Refuse files that cannot be written; raise `InputError`."""
    for name, endings in (("recording", ()), ("report", ()), ("picture", PICTURES)):
        if (file := getattr(args, name)) is not None:
            check_writable(f"--{name}", file, endings)


command = TuneCommand()


def controller(text: str) -> dict[str, float]:
    """Return the gains of `--online` by name."""
    names, parts = ("Kp", "Ti", "Td"), text.split(",")
    try:
        return {name: float(part) for name, part in zip(names[: len(parts)], parts, strict=True)}
    except ValueError:
        raise UnusableValueError("is not one to three numbers", text, "Write KP,TI,TD, such as 1.2,8,0.5.") from None
