"""`autotuner tune INNER --cascade OUTER`: both loops of a cascade, one after the other.

    both in place -> INNER tuned, its gains written -> INNER closed -> OUTER tuned through the set point of INNER

Invariants:

1. Nothing is moved before both loops are known to be a cascade that can be tuned.
2. The outer loop stays in manual while the inner one is tuned. The inner loop stays in auto afterwards: to close it was
   the request.
"""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import say, show
from autotuner.commands.tuning.one_tuning import OneTuning, run_until_end
from autotuner.control.clock.call_timeout import BackendWithTimeout
from autotuner.control.devices.retrying import quietly
from autotuner.control.driving.lease import tolerance_of
from autotuner.errors import AutotunerError, InputError
from autotuner.ports import AUTO, OUTPUT, SET_POINT

if TYPE_CHECKING:
    import signal
    from collections.abc import Collection
    from pathlib import Path

    from autotuner.configuration import Configuration, LoopTable
    from autotuner.ports import Backend

READ_LIMIT_S = 10.0
"""Longest call of a device that is only read, s: twice the usual time limit of a link."""
RELAY_ONLY = ("amplitude", "ratio", "pv_amplitude", "max_amplitude", "hysteresis", "online", "side", "also_record")
"""Options that are about one loop: two loops have them in their tables."""


def arguments_of(args: argparse.Namespace, inner: str, outer: str) -> tuple[argparse.Namespace, argparse.Namespace]:
    """Return the arguments of each loop's tuning; raise `InputError` for options that do not apply to two loops."""
    if inner == outer:
        raise InputError("is the inner loop itself", field="--cascade", value=outer, remedy="Name the outer loop.")
    if given := next((name for name in RELAY_ONLY if getattr(args, name) is not None), None):
        option = f"--{given.replace('_', '-')}"
        remedy = f"Leave out {option}, or set it in [loops.{inner}.relay] and [loops.{outer}.relay]."
        raise InputError("is for one loop, and a cascade has two", field=option, remedy=remedy)
    files = {name: _of_inner(getattr(args, name), inner) for name in ("recording", "report", "picture")}
    first = argparse.Namespace(**vars(args) | files | {"loop": inner, "apply": True})
    return first, argparse.Namespace(**vars(args) | {"loop": outer})


def _of_inner(file: Path | None, inner: str) -> Path | None:
    """Return the path of the inner loop's file, next to that of the outer one."""
    return None if file is None else file.with_name(f"{file.stem}-{inner}{file.suffix}")


async def check_cascade(inner: Backend, outer: Backend, names: tuple[str, str], loop: LoopTable) -> None:
    """Read both loops; raise `InputError` where they are no cascade or the outer one is in automatic.

    `loop` is the outer one, `names` are those of the inner and the outer loop.
    """
    below = await _look(inner, (SET_POINT, AUTO))
    above = await _look(outer, (OUTPUT, AUTO))
    if above.get(AUTO):
        raise InputError(
            "is in automatic, and would wind up while the inner loop is tuned",
            field="--cascade",
            value=names[1],
            remedy="Put it to manual first; the tuning leaves it there.",
        )
    if below.get(AUTO):
        _require_joined(below, above, names, loop)


async def check_closed(inner: Backend, outer: Backend, names: tuple[str, str], loop: LoopTable) -> None:
    """Read both loops once the inner one is closed; raise `InputError` unless one is the set point of the other."""
    _require_joined(await _look(inner, (SET_POINT,)), await _look(outer, (OUTPUT,)), names, loop)


def _require_joined(below: dict[str, float], above: dict[str, float], names: tuple[str, str], loop: LoopTable) -> None:
    tolerance = tolerance_of(loop.experiment_settings().limits)
    if not abs(below[SET_POINT] - above[OUTPUT]) <= tolerance:
        raise InputError(
            f"has output {above[OUTPUT]:g}, and the set point of {names[0]} is {below[SET_POINT]:g}",
            field="--cascade",
            value=names[1],
            remedy=f"Map the output of {names[1]} to the set point of {names[0]}.",
        )


async def _look(backend: Backend, names: Collection[str]) -> dict[str, float]:
    """Return the available signals of a device that is only polled."""
    missing = {SET_POINT, OUTPUT} & set(names) - set(backend.readable)
    if missing:
        raise InputError(
            "is not mapped, and a cascade needs it", field=f"signals.{missing.pop()}", remedy="Map it for reading."
        )
    device = BackendWithTimeout(backend, READ_LIMIT_S)
    try:
        await device.open()
        return await device.read([name for name in names if name in device.readable])
    finally:
        await quietly(device.close())


class CascadeTuning:
    """The tunings of both loops, from their options to their results."""

    def __init__(self, configuration: Configuration, args: argparse.Namespace) -> None:
        if args.loop is None:
            raise InputError("is needed beside --cascade", field="loop", remedy="Name the inner loop first.")
        first, second = arguments_of(args, args.loop, args.cascade)
        self._inner = OneTuning(configuration, first, close=True)
        self._outer = OneTuning(configuration, second)
        self._as_json = bool(args.json)
        self._running, self._stopped = self._inner, False
        self._trouble: AutotunerError | None = None
        if self._inner.simulated != self._outer.simulated:
            raise InputError(
                "is on a plant of another kind", field="--cascade", value=args.cascade, remedy="Name two real loops."
            )

    def conduct(self) -> None:
        """Run to the end."""
        run_until_end(self._work(), self._abort, virtual=self._inner.virtual)

    def show(self) -> int:
        """Write the files and print both results; return the exit code."""
        if self._as_json:
            show(json.dumps({run.tuning.loop: run.tuning.to_dict() for run in self._conducted}) + "\n")
        codes = [run.show(printed=not self._as_json) for run in self._conducted]
        if self._trouble is not None:
            say(self._trouble)
        return max(*codes, 0 if self._outer in self._conducted else 1)

    @property
    def _conducted(self) -> list[OneTuning]:
        return [run for run in (self._inner, self._outer) if run.tuning.ended]

    async def _work(self) -> None:
        inner, outer = self._inner, self._outer
        pair = inner.backend, outer.backend, (inner.tuning.loop, outer.tuning.loop), outer.loop
        await check_cascade(*pair)
        say(f"inner loop {inner.tuning.loop}")
        await inner.work()
        if not inner.after.closed or self._stopped:
            return
        say(f"inner loop {inner.tuning.loop} is closed: in auto with its new gains")
        try:
            await check_closed(*pair)
        except AutotunerError as error:  # the result of the inner loop is shown nevertheless
            self._trouble = error
            return
        self._running = outer
        say(f"outer loop {outer.tuning.loop}, through the set point of {inner.tuning.loop}")
        await outer.work()

    def _abort(self, number: signal.Signals) -> None:
        """End the tuning that runs; the outer loop is not begun any more."""
        self._stopped = True
        self._running.abort(number)
