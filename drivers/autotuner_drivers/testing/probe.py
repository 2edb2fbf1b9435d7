"""First contact with a device, without moving the output.

The probe connects, reads for a while at the highest rate of the device, and reports the duration of a reading, the
update interval of the PV, the plausibility of values, and a sample time for the loop.

Invariants: nothing is written, not even a heartbeat; `probe` measures and `evaluate` evaluates, and the evaluation
is pure.
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
"""Ratio of the advised sample time to the 95 % quantile of the duration of a reading."""
SHORTEST_SAMPLE_S: Final = 0.01
"""Shortest advised sample time, and pause between two readings, s."""
MAD_TO_SIGMA: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
ROUNDING: Final = 1e-12
"""Relative change of a value below which a change is rounding."""


@runtime_checkable
class Beating(Protocol):
    """A backend that writes a heartbeat while it reads."""

    def only_read(self) -> None:
        """Stop writing the heartbeat."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: start and duration, s, and the values, or the error."""

    t: float
    took_s: float
    values: dict[str, float]
    error: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a probe.

    Attributes
    ----------
    readings, failures : int
        Number of readings, and of failed readings.
    took_median_s, took_p95_s, took_max_s : float
        Duration of a reading of all signals, s.
    pv_low, pv_high : float
        Range of the PV; NaN without a valid reading.
    fresh_every_s : float
        Median time between changes of the PV, s; NaN when it did not change.
    pv_noise : float
        Standard deviation of the PV's noise, from the median of its changes; NaN when it did not change.
    pv_resolution : float
        Smallest change of the PV; NaN when it did not change.
    values : dict
        Last reading of each signal.
    sample_time_s : float
        Advised sample time, s; NaN when the device cannot be read.
    doubts : tuple of str
        Findings to check before a tuning.
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
    """Evaluate the readings.

    Parameters
    ----------
    readings : sequence of Reading
        At least one, in order of time.
    pv_limits : tuple of float
        Range in which the PV is plausible.
    """
    valid = [reading for reading in readings if not reading.error]
    took = sorted(reading.took_s for reading in valid) or [math.nan]
    pvs = [reading.values[PV] for reading in valid if math.isfinite(reading.values[PV])]
    fresh_s = _fresh_every(valid)
    changes = [abs(b - a) for a, b in pairwise(pvs) if abs(b - a) > ROUNDING * max(abs(a), abs(b))]
    slowest_s = took[min(math.ceil(0.95 * len(took)), len(took)) - 1]
    return Report(
        readings=len(readings),
        failures=len(readings) - len(valid),
        took_median_s=median(took),
        took_p95_s=slowest_s,
        took_max_s=took[-1],
        pv_low=min(pvs, default=math.nan),
        pv_high=max(pvs, default=math.nan),
        fresh_every_s=fresh_s,
        pv_noise=MAD_TO_SIGMA * median(changes) / math.sqrt(2.0) if changes else math.nan,
        pv_resolution=min(changes, default=math.nan),
        values=valid[-1].values if valid else {},
        sample_time_s=_sample_time(slowest_s, fresh_s),
        doubts=tuple(_doubts(readings, valid, pvs, pv_limits, fresh_s)),
    )


def _fresh_every(valid: Sequence[Reading]) -> float:
    changes = [b.t for a, b in pairwise(valid) if a.values[PV] != b.values[PV]]
    return median(b - a for a, b in pairwise(changes)) if len(changes) > 1 else math.nan


def _sample_time(slowest_s: float, fresh_s: float) -> float:
    """Return the shortest safe sample time, rounded up to two digits; each sample has a margin and a fresh value."""
    least_s = max(MARGIN * slowest_s, SHORTEST_SAMPLE_S, 0.0 if math.isnan(fresh_s) else fresh_s)
    if math.isnan(least_s):
        return math.nan
    digit = 10.0 ** (math.floor(math.log10(least_s)) - 1)
    return math.ceil(least_s / digit - 1e-9) * digit


def _doubts(
    readings: Sequence[Reading],
    valid: Sequence[Reading],
    pvs: Sequence[float],
    pv_limits: tuple[float, float],
    fresh_s: float,
) -> list[str]:
    beyond = [pv for pv in pvs if not pv_limits[0] <= pv <= pv_limits[1]]
    last = valid[-1].values if valid else {}
    found = {
        f"{len(readings) - len(valid)} of {len(readings)} readings failed: {_last_error(readings)}": len(valid)
        < len(readings),
        "no reading of the PV was a number: check the sensor and `invalid`": bool(valid) and not pvs,
        f"the PV read {beyond[0] if beyond else 0.0:g}, beyond its limits {pv_limits}": bool(beyond),
        "the PV never changed: it may be frozen, or coarser than its noise": bool(pvs) and math.isnan(fresh_s),
        "the output cannot be read back: it is restored to `safe_output`": bool(valid) and OUTPUT not in last,
        "the mode cannot be read: a change to auto cannot be detected": bool(valid) and AUTO not in last,
        "the device is in auto: a tuning switches it to manual and back": last.get(AUTO) == 1.0,
    }
    return [doubt for doubt, holds in found.items() if holds]


def _last_error(readings: Sequence[Reading]) -> str:
    return next((reading.error for reading in reversed(readings) if reading.error), "")
