"""The command `conformance`: run the checks of `conformance` on a driver and the device of a configured loop."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import AutotunerError
from autotuner_drivers.conformance import CHECKS, run
from autotuner_drivers.conformance_bench import Subject
from autotuner_drivers.loop_file import Loop, driver_named, read_loop

if TYPE_CHECKING:
    from autotuner_drivers.conformance import Outcome

DESCRIPTION: Final = """Run the published checks on a driver.

The output of the device MOVES by --step: run it on a plant that may be moved.
Without --config the driver `simulated` is run on a plant of its own."""

SIMULATED: Final[dict[str, Any]] = {
    "plant": {"structure": "fopdt", "K": 2.0, "T": 2.0, "D": 0.3},
    "output0": 40.0,
    "pv0": 80.0,
    "noise": 0.05,
}
MARKS: Final = {True: "passed ", False: "FAILED ", None: "skipped"}


class ConformanceCommand:
    """What the command line needs of a command: `help`, `configure`, `run`."""

    help = "check a driver against the rules that every driver keeps"

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the command."""
        parser.description = DESCRIPTION
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        parser.epilog = "checks:\n" + "\n".join(f"  {name}: {_first_line(name)}" for name in CHECKS)
        parser.add_argument("driver", help="name under which the driver is announced, such as modbus")
        parser.add_argument("--config", type=Path, help="TOML file of loops; its loop's device is used")
        parser.add_argument("--loop", help="the loop's name; may be left out when there is only one")
        parser.add_argument("--step", type=float, default=5.0, help="move of the output (default %(default)s)")
        parser.add_argument("--response-s", type=float, default=30.0, help="longest wait for the PV (%(default)s)")
        parser.add_argument("--call-limit-s", type=float, default=10.0, help="longest call (default %(default)s)")
        parser.add_argument("--json", action="store_true", help="print one JSON object a check")

    def run(self, args: argparse.Namespace) -> int:
        """Run the checks; return 0 when none failed, 1 when one did, 2 when they cannot be run."""
        try:
            subject = _subject(args)
        except AutotunerError as error:
            sys.stderr.write(f"conformance: {error}\n")
            return 2
        outcomes = asyncio.run(run(subject))
        for outcome in outcomes:
            sys.stdout.write((_as_json if args.json else _as_text)(outcome) + "\n")
        return int(any(outcome.passed is False for outcome in outcomes))


command = ConformanceCommand()


def _subject(args: argparse.Namespace) -> Subject:
    loop = Loop("plant", args.driver, SIMULATED) if args.config is None else read_loop(args.config, args.loop)
    factory = driver_named(args.driver)
    factory(loop.device)
    return Subject(
        create=lambda: factory(loop.device),
        low=loop.output[0],
        high=loop.output[1],
        step=args.step,
        response_s=args.response_s,
        call_limit_s=args.call_limit_s,
    )


def _first_line(check: str) -> str:
    return (CHECKS[check].__doc__ or "").splitlines()[0].removeprefix("Check that ").rstrip(".")


def _as_text(outcome: Outcome) -> str:
    return f"{MARKS[outcome.passed]}  {outcome.check}" + (f": {outcome.found}" if outcome.found else "")


def _as_json(outcome: Outcome) -> str:
    return json.dumps({"check": outcome.check, "passed": outcome.passed, "found": outcome.found})
