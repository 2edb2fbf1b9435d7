"""The command `probe`: first contact with the device of a configured loop; nothing is moved."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from autotuner.errors import AutotunerError, InputError
from autotuner_drivers.loop_file import read_loop
from autotuner_drivers.probe import judge, probe

if TYPE_CHECKING:
    import argparse

    from autotuner_drivers.loop_file import Loop
    from autotuner_drivers.probe import Report

DEFAULT_FILE: Final = Path("autotuner.toml")


class ProbeCommand:
    """What the command line needs of a command: `help`, `configure`, `run`."""

    help = "look at a loop's device without moving anything: connection, values, times, possible sample time"

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the command."""
        parser.description = "Look at the device of a loop without moving anything."
        parser.add_argument("loop", nargs="?", help="the loop's name; may be left out when there is only one")
        parser.add_argument("--config", type=Path, default=DEFAULT_FILE, help="TOML file of loops (%(default)s)")
        parser.add_argument("--seconds", type=float, default=10.0, help="how long to read (default %(default)s)")
        parser.add_argument("--json", action="store_true", help="print one JSON object")

    def run(self, args: argparse.Namespace) -> int:
        """Probe; return 0 when the device could be read, 1 when it could not, 2 when the loop cannot be used."""
        try:
            loop = read_loop(args.config, args.loop)
            backend = loop.create()
        except InputError as error:
            return _failed(2, error)
        try:
            report = judge(asyncio.run(probe(backend, args.seconds)), loop.pv)
        except AutotunerError as error:
            return _failed(1, error)
        sys.stdout.write((_as_json if args.json else _as_text)(loop, report) + "\n")
        return int(report.failures == report.readings)


command = ProbeCommand()


def _failed(code: int, error: AutotunerError) -> int:
    sys.stderr.write(f"probe: {error}\n")
    return code


def _as_json(loop: Loop, report: Report) -> str:
    return json.dumps({"loop": loop.name, "driver": loop.driver} | report.to_dict())


def _as_text(loop: Loop, report: Report) -> str:
    doubts = [f"  look at      {doubt}" for doubt in report.doubts]
    if report.failures == report.readings:
        return "\n".join([f"{loop.name} by driver {loop.driver}: connected, but nothing could be read", *doubts])
    values = ", ".join(f"{name} {value:g}" for name, value in sorted(report.values.items()))
    times = f"median {report.took_median_s:.4f} s, 95 % {report.took_p95_s:.4f} s, longest {report.took_max_s:.4f} s"
    lines = [
        f"{loop.name} by driver {loop.driver}",
        f"  readings     {report.readings}, of which {report.failures} failed",
        f"  a reading    {times}",
        f"  values       {values}",
        f"  PV           {report.pv_low:g} to {report.pv_high:g}, fresh every {report.fresh_every_s:.3g} s",
        f"  sample time  {report.sample_time_s:.3g} s or longer",
    ]
    return "\n".join(lines + doubts)
