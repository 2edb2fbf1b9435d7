"""Commands `conformance` and `probe`, and the loop of a configuration file that they work on."""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import sys
import tomllib
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import AutotunerError, ConfigurationError, InputError
from autotuner_drivers.options import Options
from autotuner_drivers.testing.conformance import CHECKS, Subject, run
from autotuner_drivers.testing.discovery import ADDRESSES, discover
from autotuner_drivers.testing.link import TcpLink, absent, address_of, moved
from autotuner_drivers.testing.probe import judge, probe

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.ports import Backend, BackendFactory
    from autotuner_drivers.testing.conformance import Outcome
    from autotuner_drivers.testing.discovery import Discovery
    from autotuner_drivers.testing.probe import Report


OUTPUT_LIMITS: Final = (0.0, 100.0)
ANY_PV: Final = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop's device.

    Attributes
    ----------
    name, driver : str
        The loop's name and its driver's.
    device : mapping
        The driver's options.
    output, pv : tuple of float
        Limits of the output and of the PV; the PV's are infinite when they are not given.
    """

    name: str
    driver: str
    device: Mapping[str, object]
    output: tuple[float, float] = OUTPUT_LIMITS
    pv: tuple[float, float] = ANY_PV

    def create(self) -> Backend:
        """Return a closed backend; raise `ConfigurationError` naming the key, the value and the remedy."""
        return driver_named(self.driver)(self.device)

    def read_only(self) -> Loop:
        """Return the loop without messages that a driver sends on its own: Modbus heartbeat, MQTT last will."""
        device = {key: value for key, value in self.device.items() if key != "will"}
        if isinstance(registers := device.get("registers"), dict):
            device["registers"] = {name: register for name, register in registers.items() if name != "heartbeat"}
        return replace(self, device=device)


def driver_named(name: str) -> BackendFactory:
    """Return the factory of an installed driver."""
    found = {point.name: point for point in entry_points(group="autotuner.drivers")}
    if name not in found:
        raise ConfigurationError(
            "is not an installed driver", field="driver", value=name, remedy=f"Use one of {', '.join(sorted(found))}."
        )
    factory: BackendFactory = found[name].load()
    return factory


def read_loop(file: Path, name: str | None) -> Loop:
    """Read a loop of a TOML file.

    Parameters
    ----------
    file : Path
        The file.
    name : str, optional
        The loop's name; may be left out when the file has one loop only.

    Raises
    ------
    ConfigurationError
        The file cannot be read, or has no such loop, or a key is wrong.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot be used: {error}", field=str(file), remedy="Give a TOML file.") from error
    loops = Options(values).table("loops", {})
    chosen = name or (next(iter(loops), None) if len(list(loops)) == 1 else None)
    if chosen is None or chosen not in loops:
        raise ConfigurationError(
            f"is not a loop of {file}", field="loop", value=name, remedy=f"Use one of {', '.join(loops)}."
        )
    loop = loops.table(chosen)
    limits = loop.table("limits", {})
    return Loop(
        chosen,
        loop.text("driver"),
        loop.table("device", {}).values,
        limits.span("output", OUTPUT_LIMITS),
        limits.span("pv", ANY_PV),
    )


DESCRIPTION: Final = """Run the published checks on a driver.

The output of the device MOVES by --step: run it on a plant that may be moved.
Without --config the driver `simulated` is run on a plant of its own."""

EXAMPLES: Final = """examples:
  autotuner conformance simulated
  autotuner conformance modbus --config loops.toml --loop TIC-101 --step 5

"""
PROBES: Final = """examples:
  autotuner probe TIC-101 --config loops.toml
  autotuner probe modbus://192.168.0.10:502 --toml loops.toml
"""
SIMULATED: Final[dict[str, Any]] = {
    "plant": {"structure": "fopdt", "K": 2.0, "T": 2.0, "D": 0.3},
    "output0": 40.0,
    "pv0": 80.0,
    "noise": 0.05,
}
MARKS: Final = {True: "passed ", False: "FAILED ", None: "skipped"}


class ConformanceCommand:
    """Command `conformance`, with the `help`, `configure` and `run` that the command line requires."""

    help = "check a driver against the rules of the driver interface"

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the command."""
        parser.description = DESCRIPTION
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        parser.epilog = EXAMPLES + "checks:\n" + "\n".join(f"  {name}: {_first_line(name)}" for name in CHECKS)
        parser.add_argument("driver", help="entry point name of the driver, such as modbus")
        parser.add_argument("--config", type=Path, help="TOML file of loops; its loop's device is used")
        parser.add_argument("--loop", help="the loop's name; may be left out when there is only one")
        parser.add_argument("--step", type=float, default=5.0, help="move of the output (default %(default)s)")
        parser.add_argument("--response-s", type=float, default=30.0, help="longest wait for the PV (%(default)s)")
        parser.add_argument("--call-limit-s", type=float, default=10.0, help="longest call (default %(default)s)")
        parser.add_argument("--json", action="store_true", help="print one JSON object a check")

    def run(self, args: argparse.Namespace) -> int:
        """Run the checks; return 0 when none failed, 1 when one did, 2 when they cannot be run."""
        try:
            outcomes = asyncio.run(_outcomes(args))
        except AutotunerError as error:
            return _failed(2, error)
        for outcome in outcomes:
            sys.stdout.write((_outcome_as_json if args.json else _outcome_as_text)(outcome) + "\n")
        return int(any(outcome.passed is False for outcome in outcomes))


conformance_command = ConformanceCommand()


async def _outcomes(args: argparse.Namespace) -> list[Outcome]:
    """Run the checks; a device with an address is reached through a link that can be interrupted."""
    loop = Loop("plant", args.driver, SIMULATED) if args.config is None else read_loop(args.config, args.loop)
    factory, options, link = driver_named(args.driver), loop.device, None
    factory(options)
    if (address := address_of(options)) is not None:
        link = TcpLink(*address)
        await link.start()
        options = moved(options, link.port)
    unreachable = absent(loop.device)
    try:
        return await run(
            Subject(
                create=lambda: factory(options),
                low=loop.output[0],
                high=loop.output[1],
                step=args.step,
                response_s=args.response_s,
                call_limit_s=args.call_limit_s,
                unreachable=None if unreachable is None else lambda: factory(unreachable),
                link=link,
            )
        )
    finally:
        if link is not None:
            await link.close()


def _first_line(check: str) -> str:
    return (CHECKS[check].__doc__ or "").splitlines()[0].removeprefix("Check that ").rstrip(".")


def _outcome_as_text(outcome: Outcome) -> str:
    return f"{MARKS[outcome.passed]}  {outcome.check}" + (f": {outcome.found}" if outcome.found else "")


def _outcome_as_json(outcome: Outcome) -> str:
    return json.dumps({"check": outcome.check, "passed": outcome.passed, "found": outcome.found})


USUAL_SAMPLE_S: Final = 0.5
"""Sample time of a guessed loop that could not be read often enough, s."""
DEFAULT_FILE: Final = Path("autotuner.toml")


class ProbeCommand:
    """Command `probe`, with the `help`, `configure` and `run` that the command line requires."""

    help = "inspect a loop's device without moving the output: connection, values, times, possible sample time"

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the command."""
        parser.description = "Inspect the device of a loop, or search an address, without moving any output."
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        parser.epilog = f"{PROBES}\naddresses:\n{ADDRESSES}"
        parser.add_argument(
            "loop",
            nargs="?",
            help="the loop's name; or an address to search, such as modbus://HOST:PORT",
        )
        parser.add_argument("--toml", type=Path, help="for an address: write a configuration file with guessed signals")
        parser.add_argument("--config", type=Path, default=DEFAULT_FILE, help="TOML file of loops (%(default)s)")
        parser.add_argument("--seconds", type=float, default=10.0, help="how long to read (default %(default)s)")
        parser.add_argument("--json", action="store_true", help="print one JSON object")

    def run(self, args: argparse.Namespace) -> int:
        """Probe; return 0 when the device could be read, 1 when it could not, 2 when the loop cannot be used."""
        if args.loop and "://" in args.loop:
            return _search(args)
        try:
            loop = read_loop(args.config, args.loop).read_only()
            backend = loop.create()
        except InputError as error:
            return _failed(2, error)
        try:
            report = judge(asyncio.run(probe(backend, args.seconds)), loop.pv)
        except AutotunerError as error:
            return _failed(1, error)
        sys.stdout.write((_report_as_json if args.json else _report_as_text)(loop, report) + "\n")
        return int(report.failures == report.readings)


probe_command = ProbeCommand()


def _search(args: argparse.Namespace) -> int:
    """Print the results of a search and the read rate of the guessed loop, and write the configuration file."""
    if args.toml is not None and args.toml.exists():
        return _failed(2, InputError("exists already", field="--toml", value=str(args.toml), remedy="Name a new file."))
    try:
        found, report = asyncio.run(_discovered(args.loop, args.seconds))
        text = found.toml(report.sample_time_s if math.isfinite(report.sample_time_s) else USUAL_SAMPLE_S)
        if args.toml is not None:
            with args.toml.open("x", encoding="utf-8") as new:
                new.write(text)
    except InputError as error:
        return _failed(2, error)
    except AutotunerError as error:
        return _failed(1, error)
    sys.stdout.write((_discovery_as_json if args.json else _discovery_as_text)(args.loop, found, report, text) + "\n")
    return 0


async def _discovered(address: str, seconds: float) -> tuple[Discovery, Report]:
    """Search an address, read the guessed loop, and return both results."""
    from autotuner_drivers.testing.searches import search_named  # noqa: PLC0415 - keeps the libraries out of `--help`

    found = await discover(search_named(address))
    backend = driver_named(found.driver)(found.device)
    return found, judge(await probe(backend, seconds), found.pv_range or ANY_PV)


def _discovery_as_text(address: str, found: Discovery, report: Report, text: str) -> str:
    guess = Loop("the guess", found.driver, found.device)
    places = [f"{address}: {len(found.found)} places can be read", *map(str, found.found)]
    return "\n".join([*places, *(f"  {note}" for note in found.notes), "", _report_as_text(guess, report), "", text])


def _discovery_as_json(address: str, found: Discovery, report: Report, text: str) -> str:
    places = [
        {
            "place": f.place.name, "value": f.values[-1], "unit": f.place.unit, "range": f.place.range,
            "writable": f.place.writable, "plausible_pv": f.plausible, "noise": f.noise, "resolution": f.resolution,
        }
        for f in found.found
    ]  # fmt: skip
    held = {"address": address, "driver": found.driver, "places": places, "notes": found.notes}
    return json.dumps(held | {"guess": report.to_dict(), "toml": text})


def _failed(code: int, error: AutotunerError) -> int:
    sys.stderr.write(f"autotuner: {error}\n")
    return code


def _report_as_json(loop: Loop, report: Report) -> str:
    return json.dumps({"loop": loop.name, "driver": loop.driver} | report.to_dict())


def _report_as_text(loop: Loop, report: Report) -> str:
    doubts = [f"  check        {doubt}" for doubt in report.doubts]
    if report.failures == report.readings:
        return "\n".join([f"{loop.name} by driver {loop.driver}: connected, but nothing could be read", *doubts])
    values = ", ".join(f"{name} {value:g}" for name, value in sorted(report.values.items()))
    times = f"median {report.took_median_s:.4f} s, 95 % {report.took_p95_s:.4f} s, longest {report.took_max_s:.4f} s"
    pv = f"{report.pv_low:g} to {report.pv_high:g}, fresh every {report.fresh_every_s:.3g} s"
    lines = [
        f"{loop.name} by driver {loop.driver}",
        f"  readings     {report.readings}, of which {report.failures} failed",
        f"  a reading    {times}",
        f"  values       {values}",
        f"  PV           {pv}, noise {report.pv_noise:.2g}, steps of {report.pv_resolution:.2g}",
        f"  sample time  {report.sample_time_s:.3g} s or longer",
    ]
    return "\n".join(lines + doubts)
