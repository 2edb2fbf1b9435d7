"""A device around a plant: it scans, and in auto its own PID controller drives the output.

    u = Kp (r - y) + I - Kp Td dyf/dt,     dI/dt = (Kp / Ti) (r - y),     yf = y / (1 + s Td / 8)

ISA form with the derivative on the filtered reading `y` only, integrated by steps of the scan time. In manual the
integral follows the output, so going to auto does not bump; at a limit of the output the integral is held
(Astrom and Hagglund, Advanced PID Control, 2006, sections 3.3 to 3.5).

`r`, `y` PV units; `u`, `I` output units; `Kp` output/PV; `Ti`, `Td` s, `Ti = 0` for none.

Invariants: it has no clock and no wire: its caller passes the time. A command that comes in auto is
lost, as in a real device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

DERIVATIVE_FILTER = 8.0
"""Derivative time over the time constant of its filter; 8 to 20 are usual in controllers (Astrom and Hagglund)."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the device's own controller: `kp` output/PV, `ti` and `td` s."""

    kp: float = 1.0
    ti: float = 20.0
    td: float = 0.0


@dataclass(frozen=True, slots=True)
class Watchdog:
    """Reaction to a silent master in manual: the output becomes `safe_output` after `limit_s` without a beat."""

    limit_s: float
    safe_output: float


class Plant(Protocol):
    """Process of a device: a `SteppedPlant`, or the inner loop of a cascade with the process after it."""

    output: float

    @property
    def t(self) -> float:
        """Time, s."""

    @property
    def pv(self) -> float:
        """The PV without noise, PV units."""

    @property
    def position(self) -> float:
        """Position of the actuator, output units."""

    def measure(self) -> float:
        """Return a reading of the PV."""

    def advance(self, t: float) -> None:
        """Go on to time `t`, s."""


class LoopDevice:
    """One loop of a controller: plant, scan, mode and PID.

    Parameters
    ----------
    plant : Plant
        The physics; the device advances it.
    scan_s : float
        Time between two readings of the device, s.
    limits : tuple of float
        Lowest and highest output, output units.
    gains : Gains
        Gains of the device's controller.
    set_point : float, optional
        Set point, PV units; the PV at the start by default.
    auto : bool
        Whether its own controller drives the output.
    watchdog : Watchdog, optional
        Armed by the first beat that is not 0, disarmed by a beat of 0.

    Attributes
    ----------
    watchers : list of callable
        Called at each scan with the time, s, and the PV without noise; the outer loop of a cascade uses it.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        scan_s: float = 0.05,
        limits: tuple[float, float] = (0.0, 100.0),
        gains: Gains | None = None,
        set_point: float | None = None,
        auto: bool = False,
        watchdog: Watchdog | None = None,
    ) -> None:
        if not 0.0 < scan_s < math.inf:
            raise ValueError(f"scan_s must be positive (got {scan_s}). Give the time between two scans in seconds.")
        self._plant = plant
        self.watchers: list[Callable[[float, float], None]] = []
        self._scan_s, self._start_s, self.scans = scan_s, plant.t, 0
        self._limits = limits
        self.gains = gains or Gains()
        self.set_point = plant.pv if set_point is None else set_point
        self._auto = auto
        self._watchdog, self.beat, self._beat_s, self.alarm = watchdog, 0, plant.t, False
        self.reading = plant.measure()
        self._filtered = self.reading
        self._integral = 0.0
        self._follow_output()

    @property
    def output(self) -> float:
        """The output, output units."""
        return self._plant.output

    @property
    def position(self) -> float:
        """Position of the actuator, output units."""
        return self._plant.position

    @property
    def auto(self) -> bool:
        """Whether the device's own controller drives the output."""
        return self._auto

    @auto.setter
    def auto(self, value: bool) -> None:
        self._follow_output()
        self._auto = value

    def command(self, output: float) -> None:
        """Set the output in manual, within the limits; in auto the command is lost."""
        if not self._auto:
            self._plant.output = self._limited(output)

    def take_beat(self, count: int) -> None:
        """Take a sign of life of the master: a count that differs from the last one, 0 when it is done."""
        if count != self.beat:
            self.beat, self._beat_s, self.alarm = count, self._plant.t, False

    def measure(self) -> float:
        """Return a new reading at the present time, PV units."""
        return self._plant.measure()

    def advance(self, t: float) -> None:
        """Advance to time `t`, s, with every scan on the way."""
        while (scan_at_s := self._start_s + (self.scans + 1) * self._scan_s) <= t:
            self._plant.advance(scan_at_s)
            self.scans += 1
            for watcher in self.watchers:
                watcher(scan_at_s, self._plant.pv)
            self._scan()
        self._plant.advance(t)

    def _scan(self) -> None:
        previous = self._filtered
        self.reading = self._plant.measure()
        self._watch_master()
        self._filtered += (self.reading - previous) * self._share()
        if self._auto:
            self._plant.output = self._controlled((self._filtered - previous) / self._scan_s)
        else:
            self._follow_output()

    def _watch_master(self) -> None:
        dog = self._watchdog
        if dog and self.beat and not self._auto and self._plant.t - self._beat_s > dog.limit_s:
            self.alarm = True
            self._plant.output = self._limited(dog.safe_output)

    def _share(self) -> float:
        return self._scan_s / (self._scan_s + self.gains.td / DERIVATIVE_FILTER)

    def _controlled(self, slope: float) -> float:
        error = self.set_point - self.reading
        wanted = self.gains.kp * (error - self.gains.td * slope) + self._integral
        output = self._limited(wanted)
        if output == wanted and self.gains.ti > 0.0:
            self._integral += self.gains.kp / self.gains.ti * error * self._scan_s
        return output

    def _follow_output(self) -> None:
        self._integral = self._plant.output - self.gains.kp * (self.set_point - self.reading)

    def _limited(self, output: float) -> float:
        return min(max(output, self._limits[0]), self._limits[1])
