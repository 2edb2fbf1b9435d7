"""Observation of the output in the first scans after a release, when the device's controller drives it again.

    bump  = 2 u_1 - u_2 - released at,      u_1, u_2 the output one and two scans after the mode
    noise = sqrt(5) (tolerance + `CERTAIN` s),   s standard deviation of the output while its controller drove it before

The PV is seldom at its set point after a relay, and a controller that takes over without a bump moves the output from
then on; the line through both readings, back to the release, is free of that. Its variance is 5 s^2.

A controller that does not follow the output in manual starts from another one. That is reported, not mended: the loop
is the device's again.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import statistics
from typing import TYPE_CHECKING

from autotuner.control.reporting.events import ReleaseBump
from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.control.clock.ticker import Ticker
    from autotuner.ports import Backend

SCANS = 2
"""Scans for which a released loop is watched."""
EXTRAPOLATED = math.sqrt(5.0)
"""Standard deviation of the line at the release, in that of one reading."""
CERTAIN = 4.0
"""Standard deviations of the output beyond which it has moved: 6e-5 of normal noise is."""


def noise_of(outputs: Sequence[float], tolerance: float) -> float:
    """Return the largest distance from the mean that is the noise of an output under control, output units."""
    return tolerance + (CERTAIN * statistics.stdev(outputs) if len(outputs) > 1 else 0.0)


async def bump_at_release(
    device: Backend, released_at: float, noise: float, ticker: Ticker, scan_s: float
) -> ReleaseBump | None:
    """Watch a loop that has just changed to auto; return the jump of its output, None without one.

    A link that is lost meanwhile ends the watching: output and mode have been confirmed before.
    """
    names = [name for name in (PV, OUTPUT, AUTO) if name in device.readable]
    if OUTPUT not in names:
        return None
    readings: list[dict[str, float]] = []
    with contextlib.suppress(DriverError):
        for _ in range(SCANS):
            await asyncio.sleep(scan_s)
            readings.append(await device.read(names))
    if len(readings) < SCANS or not all(math.isfinite(one[OUTPUT]) and one.get(AUTO, 1.0) for one in readings):
        return None
    first, second = readings
    bump, noise = 2.0 * first[OUTPUT] - second[OUTPUT] - released_at, EXTRAPOLATED * noise
    return ReleaseBump(ticker.now_s, bump, noise, second[PV] - first[PV]) if abs(bump) > noise else None
