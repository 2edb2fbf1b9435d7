"""First contact with a device: what can be known of it without moving anything.

It connects, reads for a while as fast as the device answers, and reports how long a reading takes, how often the PV is
fresh, whether values are plausible, and with what sample time the loop can be tuned.

Invariants: nothing is written, no heartbeat either; the measuring (`probe`) and the judging (`judge`) are
apart, and the judging is pure.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.ports import Backend

MARGIN: Final = 1.5
"""A sample should last so many times longer than all but the slowest readings."""
SHORTEST_SAMPLE_S: Final = 0.01
"""Shortest sample time that is advised, and the pause between two readings, s."""
GAUSSIAN: Final = 1.4826
"""Standard deviation of Gaussian noise over its median absolute deviation."""
ROUNDING: Final = 1e-12
"""Share of a value under which a change is rounding of its scale."""


@runtime_checkable
class Beating(Protocol):
    """A backend that writes by itself while it reads."""

    def only_read(self) -> None:
        """Write nothing by itself from now on."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: when it began, how long it took, s, and what it gave, or why it gave nothing."""

    t: float
    took_s: float
    values: dict[str, float]
    error: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """What was found.

    Attributes
    ----------
    readings, failures : int
        How many readings were tried, and how many failed.
    took_median_s, took_p95_s, took_max_s : float
        How long a reading of all signals took, s.
    pv_low, pv_high : float
        Range of the PV; NaN when there was none.
    fresh_every_s : float
        Median time between changes of the PV, s; NaN when it did not change.
    pv_noise : float
        Standard deviation of the PV's noise, by the median of its changes; NaN when it did not change.
    pv_resolution : float
        Smallest change of the PV; NaN when it did not change.
    values : dict
        The signals as read last.
    sample_time_s : float
        Sample time that the device allows, s; NaN when it cannot be read.
    doubts : tuple of str
        What an engineer should check before tuning.
    """

    readings: int
    failures: int
    took_median_s: float
    took_p95_s: float
    took_max_s: float
    pv_low: float
    pv_high: float
    fresh_every_s: float
    pv_noise: float
    pv_resolution: float
    values: dict[str, float]
    sample_time_s: float
    doubts: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values: NaN becomes None."""
        return {key: None if value != value else value for key, value in asdict(self).items()}  # noqa: PLR0124 - NaN


async def probe(backend: Backend, duration_s: float) -> list[Reading]:
    """Read all signals for `duration_s`, one reading after another, at least once.

    Raises
    ------
    DriverError
        The device cannot be reached.
    """
    clock = asyncio.get_running_loop().time
    if isinstance(backend, Beating):
        backend.only_read()
    await backend.open()
    try:
        start = clock()
        readings: list[Reading] = []
        while not readings or clock() < start + duration_s:
            readings.append(await _read(backend, start))
            await asyncio.sleep(SHORTEST_SAMPLE_S)
    finally:
        await backend.close()
    return readings


async def _read(backend: Backend, start: float) -> Reading:
    clock = asyncio.get_running_loop().time
    begun = clock()
    try:
        values, error = await backend.read(sorted(backend.readable)), ""
    except DriverError as reason:
        values, error = {}, str(reason)
    return Reading(begun - start, clock() - begun, values, error)


def judge(readings: Sequence[Reading], pv_limits: tuple[float, float] = (-math.inf, math.inf)) -> Report:
    """Return what the readings say.

    Parameters
    ----------
    readings : sequence of Reading
        At least one, in order of time.
    pv_limits : tuple of float
        Range in which the PV is plausible.
    """
    good = [reading for reading in readings if not reading.error]
    took = sorted(reading.took_s for reading in good) or [math.nan]
    pvs = [reading.values[PV] for reading in good if math.isfinite(reading.values[PV])]
    fresh_s = _fresh_every(good)
    moves = [abs(b - a) for a, b in pairwise(pvs) if abs(b - a) > ROUNDING * max(abs(a), abs(b))]
    slowest_s = took[min(math.ceil(0.95 * len(took)), len(took)) - 1]
    return Report(
        readings=len(readings),
        failures=len(readings) - len(good),
        took_median_s=median(took),
        took_p95_s=slowest_s,
        took_max_s=took[-1],
        pv_low=min(pvs, default=math.nan),
        pv_high=max(pvs, default=math.nan),
        fresh_every_s=fresh_s,
        pv_noise=GAUSSIAN * median(moves) / math.sqrt(2.0) if moves else math.nan,
        pv_resolution=min(moves, default=math.nan),
        values=good[-1].values if good else {},
        sample_time_s=_sample_time(slowest_s, fresh_s),
        doubts=tuple(_doubts(readings, good, pvs, pv_limits, fresh_s)),
    )


def _fresh_every(good: Sequence[Reading]) -> float:
    changes = [b.t for a, b in pairwise(good) if a.values[PV] != b.values[PV]]
    return median(b - a for a, b in pairwise(changes)) if len(changes) > 1 else math.nan


def _sample_time(slowest_s: float, fresh_s: float) -> float:
    """Return the shortest sample time with two leading digits that leaves a margin and gives fresh values."""
    least_s = max(MARGIN * slowest_s, SHORTEST_SAMPLE_S, 0.0 if math.isnan(fresh_s) else fresh_s)
    if math.isnan(least_s):
        return math.nan
    digit = 10.0 ** (math.floor(math.log10(least_s)) - 1)
    return math.ceil(least_s / digit - 1e-9) * digit


def _doubts(
    readings: Sequence[Reading],
    good: Sequence[Reading],
    pvs: Sequence[float],
    pv_limits: tuple[float, float],
    fresh_s: float,
) -> list[str]:
    beyond = [pv for pv in pvs if not pv_limits[0] <= pv <= pv_limits[1]]
    last = good[-1].values if good else {}
    found = {
        f"{len(readings) - len(good)} of {len(readings)} readings failed: {_last_error(readings)}": len(good)
        < len(readings),
        "the PV was never a number: check the sensor and `invalid`": bool(good) and not pvs,
        f"the PV read {beyond[0] if beyond else 0.0:g}, beyond its limits {pv_limits}": bool(beyond),
        "the PV never changed: it may be frozen, or coarser than its noise": bool(pvs) and math.isnan(fresh_s),
        "the output cannot be read back: it is restored to `safe_output`": bool(good) and OUTPUT not in last,
        "the mode cannot be read: a change to auto goes unnoticed": bool(good) and AUTO not in last,
        "the device is in auto: a tuning takes it to manual and back": last.get(AUTO) == 1.0,
    }
    return [doubt for doubt, holds in found.items() if holds]


def _last_error(readings: Sequence[Reading]) -> str:
    return next((reading.error for reading in reversed(readings) if reading.error), "")
