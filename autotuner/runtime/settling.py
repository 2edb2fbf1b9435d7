"""Waiting until a loop under its own controller rests at a set point, within its limits.

Rule of this file: the device's own controller stays in charge; nothing is written but the set point that is asked for.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.recording import Sample
from autotuner.core.safety import Supervisor
from autotuner.core.signals.quiet import measure_quiet
from autotuner.core.verdict import Verdict, aborted, refused
from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner.runtime.patient import Patient
from autotuner.runtime.restore import uncancelled
from autotuner.runtime.ticker import Stop, Ticker

if TYPE_CHECKING:
    from autotuner.configuration import LoopTable
    from autotuner.core.arrays import FloatArray
    from autotuner.ports import Backend

SIGNALS = (PV, OUTPUT, AUTO)
WINDOW = 60
"""Samples over which the loop must rest."""
WINDOWS = 60
"""So many of them are waited for."""
AT_REST = 0.5
"""Largest distance of the mean PV of either half of a window from the set point, in standard deviations of the noise,
and at least `SMALLEST_SHARE` of the move."""
SMALLEST_SHARE = 0.01


async def settle(loop: LoopTable, backend: Backend, set_point: float) -> Verdict | None:
    """Move the set point and wait until the PV rests there; return why it does not, or None.

    Parameters
    ----------
    loop : LoopTable
        The loop, in auto.
    backend : Backend
        Its device; opened and closed here.
    set_point : float
        Where to go, PV units.

    Raises
    ------
    DriverError
        The device cannot be reached, or refuses the set point.
    """
    limits = loop.experiment_settings().limits
    supervisor = Supervisor(limits, loop.safety_settings())
    device = Patient(backend, supervisor.blind_s)
    try:
        await device.open()
        before = (await device.read([SET_POINT]))[SET_POINT]
        await device.write({SET_POINT: set_point})
        return await _rests(device, supervisor, Ticker(loop.sample_time_s), (before, set_point), limits.output[0])
    finally:
        await uncancelled(device.close())


async def _rests(
    device: Patient, supervisor: Supervisor, ticker: Ticker, move: tuple[float, float], low: float
) -> Verdict | None:
    before, set_point = move
    never, window = Stop(), list[Sample]()
    for _ in range(WINDOWS * WINDOW):
        tick = await ticker.tick(never)
        assert tick is not None  # noqa: S101 - nobody sets the event
        try:
            seen = await device.read(SIGNALS)
        except DriverError:
            if lost := supervisor.check_blindness(tick.t, usable=False, still_s=device.stood_still_s(tick)):
                return lost
            continue
        if not seen[AUTO]:
            return aborted("mode_changed", "the device went to manual", "Somebody took the loop over.")
        # the device moves its output: that is not for the supervisor to judge
        held = Sample(tick.t, seen[PV], low, math.nan, tick.lateness_s)
        if trip := supervisor.check(held, phase="settling", still_s=device.stood_still_s(tick)):
            return trip
        window = [*window, held][-WINDOW:] if math.isfinite(seen[PV]) else window
        if len(window) == WINDOW and _at_rest(window, set_point, abs(set_point - before)):
            return None
    return refused(
        "not_at_rest",
        f"the PV does not come to rest at {set_point:g} within {WINDOWS * WINDOW} samples",
        "Start from gains under which the loop settles, or give points that it reaches.",
    )


def _at_rest(window: list[Sample], set_point: float, move: float) -> bool:
    t, pv = (np.array([getattr(sample, name) for sample in window]) for name in ("t", "pv"))
    return rests_at(set_point, pv, max(AT_REST * measure_quiet(t, pv).unsure, SMALLEST_SHARE * move))


def rests_at(set_point: float, pv: FloatArray, near: float) -> bool:
    """Return whether the mean PV of either half of a window is no further than `near` from the set point, PV units."""
    return all(abs(float(np.mean(half)) - set_point) <= near for half in np.array_split(pv, 2))
