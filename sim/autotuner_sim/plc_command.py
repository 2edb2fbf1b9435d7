"""The command `plc`: serve a simulated plant as a Modbus slave or a serial board, for trying without hardware."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import signal
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner_sim.cascade import OuterDevice
from autotuner_sim.coupled import coupled_plants
from autotuner_sim.devices import plc_registers
from autotuner_sim.devices.loop_device import Gains, LoopDevice, Watchdog
from autotuner_sim.devices.plant_options import EFFECTS, build_plant, parameters_of
from autotuner_sim.devices.plc import SimulatedPlc, serving_rtu, serving_tcp
from autotuner_sim.devices.tclab_board import TclabBoard
from autotuner_sim.effects import Noise
from autotuner_sim.plants.linear import PLANTS, Fopdt
from autotuner_sim.stepped import SteppedPlant

if TYPE_CHECKING:
    from collections.abc import Sequence

PLANT = ("K=2", "T=10", "D=1.5")

DESCRIPTION = f"""Serve a simulated plant as a Modbus slave, or as a serial board, until interrupted.

The first line printed is one JSON object: {{"ready": true, "pid": ..., "host": ..., "port": ...}} over TCP,
{{"ready": true, "pid": ..., "serial_port": ...}} over a pseudo-terminal.

Registers:
{(plc_registers.__doc__ or "").partition(chr(10) * 2)[2]}"""

EPILOG = """examples:
  autotuner plc
  autotuner plc --port 0 --structure sopdt_overdamped --plant K=1.2 T1=8 T2=3 D=1 --noise 0.05
  autotuner plc --rtu ./ttyPLC --unit 7
  autotuner plc --tclab ./ttyLAB --output0 0 --pv0 23
  autotuner plc --tclab ./ttyLAB --both-heaters --output0 0 --pv0 23
  autotuner plc --outer 0.5 60 5 --outer-pv0 60
  autotuner plc --auto --set-point 50 --gains 2 12 0.5 --effect backlash width=2 --speed 20
"""


class PlcCommand:
    """Command `plc`, with the `help`, `configure` and `run` that the command line requires."""

    help = "serve a simulated plant as a Modbus slave or a serial board"

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the command."""
        parser.description, parser.epilog = DESCRIPTION, EPILOG
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        _configure_wire(parser.add_argument_group("wire"))
        _configure_plant(parser.add_argument_group("plant"))
        _configure_device(parser.add_argument_group("device"))

    def run(self, args: argparse.Namespace) -> int:
        """Serve until SIGINT or SIGTERM; return 0, or 1 when the port cannot be had, 2 for a plant that cannot be."""
        try:
            plant = _plant(args)
            device = _device(args, plant)
        except (ValueError, argparse.ArgumentTypeError) as error:
            return _failed(2, str(error))
        try:
            asyncio.run(_serve(args, plant, device))
        except OSError as error:
            address = args.rtu or args.tclab or f"{args.host}:{args.port}"
            return _failed(1, f"{address} cannot be served: {error.strerror or error}. Choose another, or --port 0.")
        return 0


command = PlcCommand()


def _configure_wire(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    group.add_argument("--port", type=int, default=1502, help="TCP port, 0 for any free one (default %(default)s)")
    group.add_argument("--rtu", type=Path, metavar="LINK", help="Modbus RTU on a pseudo-terminal of this name instead")
    group.add_argument("--unit", type=int, default=1, help="unit number on the RTU line (default %(default)s)")
    group.add_argument("--tclab", type=Path, metavar="LINK", help="TCLab protocol on a pseudo-terminal instead")
    group.add_argument(
        "--both-heaters", action="store_true",
        help="with --tclab: both heaters of the board, each of which warms the other, in place of the plant",
    )  # fmt: skip


def _configure_plant(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--structure", choices=list(PLANTS), default="fopdt", help="default %(default)s")
    group.add_argument(
        "--plant", nargs="+", type=_parameter, default=[_parameter(p) for p in PLANT], metavar="NAME=VALUE",
        help=f"parameters of the structure (default {' '.join(PLANT)}); a list as lags=1,1,1",
    )  # fmt: skip
    group.add_argument("--output0", type=float, default=40.0, help="output at the start (default %(default)s)")
    group.add_argument("--pv0", type=float, default=80.0, help="PV at the start, where the plant rests (%(default)s)")
    group.add_argument(
        "--outer", nargs=3, type=float, metavar=("K", "T", "D"),
        help="a second process, which the PV drives: the outer loop of a cascade, at rest at --outer-pv0",
    )  # fmt: skip
    group.add_argument("--outer-pv0", type=float, default=50.0, help="its PV at the start (default %(default)s)")
    group.add_argument("--noise", type=float, default=0.05, help="standard deviation of readings (%(default)s)")
    group.add_argument("--seed", type=int, default=0, help="seed of the noise (default %(default)s)")
    group.add_argument("--speed", type=float, default=1.0, help="plant seconds per second (default %(default)s)")
    group.add_argument(
        "--effect", nargs="+", action="append", default=[], metavar=("NAME", "PARAMETER=VALUE"),
        help=f"hidden physics, repeatable: {', '.join(EFFECTS)}",
    )  # fmt: skip


def _configure_device(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--auto", action="store_true", help="start with its own PID driving the output")
    group.add_argument("--set-point", type=float, help="set point of the PLC's PID (default: the initial PV)")
    group.add_argument(
        "--gains", nargs=3, type=float, default=(1.0, 20.0, 0.0), metavar=("KP", "TI", "TD"),
        help="gains of the PLC's PID, ISA form (default 1 20 0)",
    )  # fmt: skip
    group.add_argument("--scan", type=float, default=0.05, help="scan time of the device, s (default %(default)s)")
    group.add_argument(
        "--watchdog", nargs=2, type=float, metavar=("SECONDS", "OUTPUT"),
        help="in manual, set OUTPUT when the master's heartbeat is missing for SECONDS",
    )  # fmt: skip
    group.add_argument(
        "--limits", nargs=2, type=float, default=(0.0, 100.0), metavar=("LOW", "HIGH"), help="of the output (0 100)"
    )


def _parameter(text: str) -> tuple[str, float | tuple[float, ...]]:
    name, separator, value = text.partition("=")
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if not (name and separator and numbers):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number, such as K=2")
    return name, numbers if len(numbers) > 1 else numbers[0]


def _plant(args: argparse.Namespace) -> SteppedPlant:
    if not 0.0 < args.speed < math.inf:
        raise ValueError(f"--speed must be positive (got {args.speed}). Give 1 for real time.")
    return build_plant(
        args.structure,
        _checked(args.structure, args.plant, PLANTS[args.structure]),
        output0=args.output0,
        pv0=args.pv0,
        noise=args.noise,
        seed=args.seed,
        limits=tuple(args.limits),
        with_effects=[_effect(words) for words in args.effect],
    )


def _plc(args: argparse.Namespace, device: LoopDevice) -> SimulatedPlc:
    """Return the PLC, with the outer loop of a cascade where one is requested."""
    outer = None
    if args.outer:
        K, T, D = args.outer
        process = SteppedPlant(
            Fopdt(K, T, D),
            output0=args.pv0,
            pv0=args.outer_pv0,
            sensors=[Noise(args.noise, seed=2 * args.seed + 1)] if args.noise else [],
        )
        outer = OuterDevice(device, process, scan_s=args.scan, limits=(-math.inf, math.inf))
    return SimulatedPlc(device, speed=args.speed, outer=outer)


def _heaters(args: argparse.Namespace) -> tuple[SteppedPlant, SteppedPlant]:
    """Return two coupled heaters with their sensors, which rest where the options say."""
    first, second = ([Noise(args.noise, seed=2 * args.seed + i)] if args.noise else [] for i in (0, 1))
    return coupled_plants(
        output0=(args.output0, args.output0),
        pv0=(args.pv0, args.pv0),
        limits=tuple(args.limits),
        sensors=(first, second),
    )


def _device(args: argparse.Namespace, plant: SteppedPlant) -> LoopDevice:
    return LoopDevice(
        plant,
        scan_s=args.scan,
        limits=tuple(args.limits),
        gains=Gains(*args.gains),
        set_point=args.set_point,
        auto=args.auto,
        watchdog=Watchdog(*args.watchdog) if args.watchdog else None,
    )


def _effect(words: Sequence[str]) -> tuple[str, dict[str, float | tuple[float, ...]]]:
    name, *parameters = words
    if name not in EFFECTS:
        raise ValueError(f"--effect {name} is not known. Use one of {', '.join(EFFECTS)}.")
    return name, _checked(name, [_parameter(p) for p in parameters], EFFECTS[name][1])


def _checked(
    name: str, given: Sequence[tuple[str, float | tuple[float, ...]]], kind: type
) -> dict[str, float | tuple[float, ...]]:
    """Return the parameters by name if they are those of `kind`; raise `ValueError` otherwise."""
    values, known = dict(given), {p.name: p for p in parameters_of(kind)}
    required = {p.name for p in known.values() if not p.optional}
    if values.keys() - known.keys() or required - values.keys():
        raise ValueError(f"{name} has the parameters {', '.join(known)} (got {', '.join(values)}). Give those.")
    return {key: (v,) if known[key].many and not isinstance(v, tuple) else v for key, v in values.items()}


async def _serve(args: argparse.Namespace, plant: SteppedPlant, device: LoopDevice) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with contextlib.AsyncExitStack() as served:
        ready = await _enter(args, plant, device, served)
        _print({"ready": True, "pid": os.getpid()} | ready)
        await stop.wait()


async def _enter(
    args: argparse.Namespace, plant: SteppedPlant, device: LoopDevice, served: contextlib.AsyncExitStack
) -> dict[str, object]:
    """Begin to serve on the requested wire; return how to reach it."""
    if args.tclab or args.rtu:
        from autotuner_sim.devices import serial_board, serial_wire  # noqa: PLC0415 - pseudo-terminals exist on POSIX only

        if args.tclab:
            board = TclabBoard(*_heaters(args)) if args.both_heaters else TclabBoard(plant)
            await served.enter_async_context(serial_board.serving_board(board, args.tclab, speed=args.speed))
            return {"serial_port": str(args.tclab)}
        near = await served.enter_async_context(serial_wire.joined_ports(args.rtu))
        await served.enter_async_context(serving_rtu(_plc(args, device), near, args.unit))
        return {"serial_port": str(args.rtu), "unit": args.unit}
    socket.create_server((args.host, args.port)).close()  # has the reason, where the library only reports the failure
    port = await served.enter_async_context(serving_tcp(_plc(args, device), args.host, args.port))
    return {"host": args.host, "port": port}


def _print(line: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def _failed(code: int, message: str) -> int:
    sys.stderr.write(f"autotuner: plc: {message}\n")
    return code
