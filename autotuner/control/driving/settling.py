"""Waiting until a loop under its own controller rests at a set point, within its limits.

Invariant: the device's own controller stays in charge; nothing is written but the requested set point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.control.devices.retrying import uncancelled
from autotuner.control.driving.drive import drive
from autotuner.core.safety.own_control import OwnControlWatch
from autotuner.core.signals.quiet import measure_quiet
from autotuner.core.verdict import Verdict, refused
from autotuner.ports import SET_POINT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.configuration import LoopTable
    from autotuner.control.driving.lease import Lease
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Sample

WINDOW = 60
"""Length of a window over which the loop must be at rest, samples."""
WINDOWS = 60
"""Number of windows after which the wait for rest ends."""
AT_REST = 0.5
"""Largest distance of the mean PV of either half of a window from the set point, in standard deviations of the
noise."""
SMALLEST_SHARE = 0.01
"""The same as a share of the move, for a PV with little noise: 1 % is stricter than any settling time."""
SHARP = 1e-6
"""The same as a share of the set point where there is no move: a PV without noise converges for ever."""


class SettlingStage:
    """The settling of a loop at a new set point; see `autotuner.control.driving.drive.Stage`.

    Parameters
    ----------
    set_point : float
        Where the loop is to rest, PV units.
    near : float
        Distance from there that counts as rest without any noise, PV units.

    Attributes
    ----------
    verdict : Verdict or None
        Why it does not settle.
    complete : bool
        Whether it has settled, or does not.
    """

    phase = "settling"

    def __init__(self, set_point: float, tolerance: float) -> None:
        self.verdict: Verdict | None = None
        self.complete = False
        self._set_point, self._near = set_point, tolerance
        self._window: list[Sample] = []
        self._taken = 0

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample."""
        self._window = [*self._window, sample][-WINDOW:]
        self._taken += 1
        if len(self._window) == WINDOW and _at_rest(self._window, self._set_point, self._near):
            self.complete = True
        elif self._taken >= WINDOWS * WINDOW:
            self.complete = True
            self.verdict = refused(
                "not_at_rest",
                f"the PV does not settle at {self._set_point:g} within {WINDOWS * WINDOW} samples",
                "Start from gains under which the loop settles, or give points that it reaches.",
            )
        return {}

    def record(self, sample: Sample) -> None:
        """Do nothing: settling is not recorded."""

    def correct(self, output: float) -> None:
        """Do nothing: the device moves its output."""

    def tolerates(self, _verdict: Verdict) -> bool:
        """Return False."""
        return False


async def settle(lease: Lease, loop: LoopTable, set_point: float) -> Verdict | None:
    """Move the set point and wait until the PV rests there; return why it does not, or None.

    Parameters
    ----------
    lease : Lease
        That of the run, held; its device is connected and disconnected here.
    loop : LoopTable
        The loop, in auto.
    set_point : float
        Where to go, PV units.

    Raises
    ------
    DriverError
        The device cannot be reached, or refuses the set point.
    """
    # other operations have driven the loop since the previous point, so earlier observations do not apply
    lease.watch = OwnControlWatch(loop.experiment_settings().limits, loop.safety_settings())
    try:
        await lease.device.open()
        before = (await lease.read([SET_POINT]))[SET_POINT]
        await lease.write({SET_POINT: set_point})
        stage = SettlingStage(set_point, SMALLEST_SHARE * abs(set_point - before))
        return await drive(lease, stage) or stage.verdict
    finally:
        await uncancelled(lease.close())


def _at_rest(window: list[Sample], set_point: float, tolerance: float) -> bool:
    t, pv = (np.array([getattr(sample, name) for sample in window]) for name in ("t", "pv"))
    return rests_at(set_point, pv, max(AT_REST * measure_quiet(t, pv).unsure, tolerance))


def rests_at(set_point: float, pv: FloatArray, tolerance: float) -> bool:
    """Return whether the mean PV of both halves of a window is within `tolerance` of the set point, PV units."""
    return all(abs(float(np.mean(half)) - set_point) <= tolerance for half in np.array_split(pv, 2))
