"""Search of an address: readable signals with units, ranges and noise, and a configuration file made from them.

    autotuner probe modbus://192.168.1.10:502

Invariants: only reads are sent; each signal is read several times, and its changes show what it may be; the
configuration file is a guess to be corrected. `searches` has the search of each protocol.
"""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean, median
from typing import TYPE_CHECKING, Final, Protocol

from autotuner.errors import InputError
from autotuner_drivers.testing.probe import MAD_TO_SIGMA

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

ADDRESSES: Final = """\
  modbus://192.168.1.10:502             units, and registers 0 to 99 of the first unit that answers
  opc.tcp://192.168.1.20:4840           the tree of variables that hold a number
  mqtt://192.168.1.5/boiler/#           topics with numbers, as they arrive
  s7://192.168.0.1/0/1                  reals of the data blocks 1 to 99; rack and slot
  ethernetip://192.168.1.40/0           tags of the controller; slot. These: ethernetip://192.168.1.40/0/TAG,TAG
  epics://192.168.1.30/LAB:T,LAB:H      these channels: Channel Access has no list of them
  serial:///dev/ttyACM0                 the protocol that answers at a port; opening it resets many boards"""
LOOKS: Final = 8
"""Readings of each signal."""
LOOK_S: Final = 0.4
"""Interval between these readings, s: a value that changes in this time is a measurement or a counter."""
LARGEST_NOISE: Final = 0.2
"""Largest change between two readings of a measurement, as a share of its level; counters and flags change more."""


@dataclass(frozen=True, slots=True)
class Place:
    """An address of the device that can be read.

    Attributes
    ----------
    name : str
        Address, for messages.
    entry : mapping
        Keys of a signal at this address in the driver's configuration.
    writable : bool
        Whether it can be written, as far as the protocol shows it.
    unit : str
        Engineering unit, where the device reports it.
    range : tuple of float, optional
        Lowest and highest value, where the device reports them.
    """

    name: str
    entry: Mapping[str, object]
    writable: bool = False
    unit: str = ""
    range: tuple[float, float] | None = None


class Search(Protocol):
    """Interface of a protocol's search."""

    driver: str
    table: str
    """Name of the table of signals in the driver's options."""
    device: dict[str, object]
    """Options that connect to the device."""
    notes: list[str]
    """Further findings, as texts."""

    async def start(self) -> list[Place]:
        """Connect, and return the readable addresses."""

    async def look(self) -> list[float]:
        """Return the value of each address; NaN where it has none."""

    async def close(self) -> None:
        """Disconnect."""


@dataclass(frozen=True, slots=True)
class Found:
    """A readable address and its readings, in order."""

    place: Place
    values: tuple[float, ...] = field(repr=False)

    @property
    def steps(self) -> list[float]:
        """Differences between neighbouring values."""
        return [b - a for a, b in pairwise(self.values)]

    @property
    def changes(self) -> bool:
        """Whether the value changed."""
        return any(self.steps)

    @property
    def resolution(self) -> float:
        """Smallest change between readings; 0 without any change."""
        return min((abs(step) for step in self.steps if step), default=0.0)

    @property
    def noise(self) -> float:
        """Standard deviation of the noise, from the median change between readings."""
        return MAD_TO_SIGMA * median(abs(step) for step in self.steps) / math.sqrt(2.0) if self.steps else 0.0

    @property
    def plausible(self) -> bool:
        """Whether the value changes like a measurement: in both directions or by unequal steps, and little."""
        moves = [step for step in self.steps if step]
        if not moves or max(map(abs, moves)) > LARGEST_NOISE * max(map(abs, self.values)):
            return False
        return min(moves) < 0.0 < max(moves) or max(moves) - min(moves) > 0.01 * abs(fmean(moves))

    def __str__(self) -> str:
        place = self.place
        marks = "PV?" if self.plausible else "changes" if self.changes else ""
        noise = f"noise {self.noise:.2g}, step {self.resolution:.2g}" if self.plausible else ""
        span = f"{place.range[0]:g} to {place.range[1]:g}" if place.range else ""
        words = f"{'writable' if place.writable else '':9}{noise:26}{span}"
        return f"  {place.name:44} {self.values[-1]:>12.6g} {place.unit:8}{marks:8}{words}".rstrip()


@dataclass(frozen=True, slots=True)
class Discovery:
    """Result of a search: the driver, its options for a guessed loop, and all readable addresses."""

    driver: str
    device: dict[str, object]
    found: list[Found]
    notes: list[str]
    pv_range: tuple[float, float] | None = None
    output_range: tuple[float, float] | None = None

    def toml(self, sample_time_s: float) -> str:
        """Return a configuration file of the guessed loop, with a sample time that the device supports."""
        low, high = self.pv_range or (0.0, 100.0)
        output = self.output_range or (0.0, 100.0)
        head = [
            "# A guess: correct the two signals, their scale, and the limits before the output is moved.",
            "[loops.new]",
            f'driver = "{self.driver}"',
            f"sample_time_s = {sample_time_s:.3g}",
            f"limits = {{ output = [{output[0]!r}, {output[1]!r}], pv = [{low!r}, {high!r}] }}",
            "",
            "[loops.new.device]",
        ]
        plain = {key: value for key, value in self.device.items() if not isinstance(value, dict)}
        lines = [f"{key} = {as_toml(value)}" for key, value in plain.items()]
        for table, entries in self.device.items():
            if isinstance(entries, dict):
                lines += ["", f"[loops.new.device.{table}]", *(f"{k} = {as_toml(v)}" for k, v in entries.items())]
        return "\n".join([*head, *lines, ""])


def as_toml(value: object) -> str:
    """Return a value of the configuration as TOML: JSON except for tables."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {as_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


async def discover(search: Search) -> Discovery:
    """Return the results of a search, with the guessed signals of a loop.

    Raises
    ------
    InputError
        No readable address holds a number.
    DriverError
        No device answers.
    """
    try:
        places = await search.start()
        looks = [await search.look()]
        for _ in range(LOOKS - 1):
            await asyncio.sleep(LOOK_S)
            looks.append(await search.look())
    finally:
        await search.close()
    read = [Found(place, tuple(look[k] for look in looks)) for k, place in enumerate(places)]
    return guessed(search, [found for found in read if not any(map(math.isnan, found.values))])


def guessed(search: Search, found: Sequence[Found]) -> Discovery:
    """Guess a loop: the PV is the first plausible measurement, the output the first writable constant value."""
    if not found:
        raise InputError("has no readable number", field="address", remedy="Give a login, or another address.")
    pv = next((f for f in found if f.plausible and not f.place.writable), None)
    pv = pv or next((f for f in found if f.plausible), None) or next((f for f in found if f.changes), found[0])
    others = [f for f in found if f is not pv]
    output = next((f for f in others if f.place.writable and not f.changes), None)
    output = output or next((f for f in others if f.place.writable), None) or (others or [pv])[0]
    signals = {"pv": dict(pv.place.entry), "output": dict(output.place.entry)}
    device = search.device | ({search.table: signals} if search.table else {})
    return Discovery(search.driver, device, list(found), search.notes, pv.place.range, output.place.range)
