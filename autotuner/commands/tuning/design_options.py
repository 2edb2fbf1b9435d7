"""The requirements on gains, as options of a command."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.commands.terminal.usage import Number, OneOf, words

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from autotuner.core.design import DesignSpec

GOALS = ("calm", "balanced", "brisk")
SMALLEST_MS = 1.0
"""A sensitivity of 1 is that of a loop without a controller."""


def add_design_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("gains")
    group.add_argument(
        "--goal", type=words(*GOALS), metavar=_one_of(GOALS), default="balanced", help="goal (default %(default)s)"
    )
    group.add_argument("--rule", type=OneOf(_rules), metavar="NAME", help="a tuning rule instead of a goal")
    group.add_argument(
        "--ms", type=Number(above=SMALLEST_MS), help="largest sensitivity Ms and Mt, instead of the goal's"
    )
    _add_choice(group, "--controller", ("P", "PI", "PID"), "PID", "parts that the controller may have")
    _add_choice(group, "--purpose", ("load", "set_point"), "load", "after which step the error is made small")
    group.add_argument(
        "--closed-loop-s",
        type=Number(above=0.0),
        metavar="S",
        help="wanted closed-loop time constant, s, as far as that is robust",
    )
    group.add_argument(
        "--jitter",
        type=Number(above=0.0),
        help="largest standard deviation of the output that the noise may cause, output units",
    )


def add_structure(group: argparse._ArgumentGroup) -> None:
    """Add the option of the process structure."""
    group.add_argument(
        "--structure", type=OneOf(_structures), metavar="NAME", default="auto", help="process structure (%(default)s)"
    )


def add_budget(group: argparse._ActionsContainer, what: str) -> None:
    """Add the option of the processor time; `what` names the work in its help."""
    group.add_argument(
        "--budget-ms",
        type=Number(above=0.0),
        metavar="MS",
        help=f"processor time {what}, ms; where least squares needs more, the learned correction gives model and gains",
    )


def design_spec_of(args: argparse.Namespace) -> DesignSpec:
    """Return the requirements; raise `InputError` for a combination that cannot be met."""
    from autotuner.core.design import DesignSpec  # noqa: PLC0415 - keeps `--help` quick

    return DesignSpec(args.goal, args.rule, args.ms, args.controller, args.purpose, args.closed_loop_s, args.jitter)


def _add_choice(group: argparse._ArgumentGroup, name: str, names: tuple[str, ...], default: str, text: str) -> None:
    group.add_argument(
        name, type=words(*names), metavar=_one_of(names), default=default, help=f"{text} (default %(default)s)"
    )


def _one_of(names: Sequence[str]) -> str:
    return f"{{{','.join(names)}}}"


def _structures() -> Sequence[str]:
    from autotuner.core.model.structures import SEARCHED  # noqa: PLC0415 - brings SciPy with it

    return ("auto", *SEARCHED)


def _rules() -> Sequence[str]:
    from autotuner.core.design import rule_names  # noqa: PLC0415 - brings SciPy with it

    return rule_names()
