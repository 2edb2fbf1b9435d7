"""What a user asks of gains, as arguments of a command."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

    from autotuner.core.tuning import Wish


def add_wish(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--goal", default="balanced", help="goal of the gains: calm, balanced, brisk")
    parser.add_argument("--rule", help="a tuning rule by name instead of a goal")
    parser.add_argument("--ms", type=float, help="largest sensitivity Ms and Mt, instead of the goal's")
    parser.add_argument(
        "--controller", choices=("P", "PI", "PID"), default="PID", help="parts that the controller may have"
    )
    parser.add_argument(
        "--purpose", choices=("load", "set_point"), default="load", help="after which step the error is made small"
    )
    parser.add_argument(
        "--closed-loop-s", type=float, metavar="S", help="wanted closed-loop time constant, s, as far as that is robust"
    )
    parser.add_argument(
        "--jitter", type=float, help="largest standard deviation of the output that the noise may cause, output units"
    )


def wish_of(args: argparse.Namespace) -> Wish:
    """Return what the arguments ask; raise `InputError` for what cannot be."""
    from autotuner.core.tuning import Wish  # noqa: PLC0415 - keeps `--help` quick

    return Wish(args.goal, args.rule, args.ms, args.controller, args.purpose, args.closed_loop_s, args.jitter)
