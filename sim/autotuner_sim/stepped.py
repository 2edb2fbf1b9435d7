"""A plant that is stepped by its caller: a test, a driver, a simulated PLC. Wire and clock are the caller's.

    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Noise(0.05, seed=1)])
    plant.output = 45.0
    plant.advance(3.7)
    plant.measure()

`t` is seconds on any scale that does not run backward. Between the changes of its input the plant moves in one exact
step from the last change, so the PV at a time does not depend on how often, or at what spacing, it was read. It
starts at rest: `output0` holds the PV at `pv0`, also for an integrating or unstable plant. Couplings and bounds (see
`couplings`) are not linear: they act in steps of `step_s`, each by the midpoint rule.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

from autotuner_sim.effects.transport import FixedDelay, Transport

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner_sim.effects.couplings import Bound, Coupling
    from autotuner_sim.effects.protocols import Actuator, Load, Offset, Sensor
    from autotuner_sim.plants.linear import Plant
    from autotuner_sim.plants.motion import State


class SteppedPlant:
    """One plant in absolute units, with its actuator, disturbances and sensor.

    Parameters
    ----------
    plant : Plant
        The linear plant.
    output0, pv0 : float
        The rest point, output and PV units.
    start_s : float
        Time at which it starts, s.
    output_limits : tuple of float, optional
        A commanded output outside of these is held at the nearer one.
    actuators : iterable of Actuator
        Effects on the command, in this order.
    loads, offsets : iterable of Load, Offset
        Disturbances at the plant's input and on its PV, which add up.
    sensors : iterable of Sensor
        Effects on the PV, in this order.
    actuator_scan_s : float, optional
        Period of the actuators from `start_s`, s, each with the command of that time; None: at each command. Required
        for an actuator that moves on its own.
    couplings, bounds : iterable of Coupling, Bound
        Feedback from the PV or the time to the input, and limits of the states.
    step_s : float, optional
        Longest step while there are couplings or bounds, which need it, s.
    transport : Transport, optional
        How positions travel to the plant; by default they take the plant's dead time.

    Raises
    ------
    ValueError
        Limits, scan or step that cannot be or is missing, or a rest point outside of the limits; names the field.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        output0: float = 0.0,
        pv0: float = 0.0,
        start_s: float = 0.0,
        output_limits: tuple[float, float] = (-math.inf, math.inf),
        actuators: Iterable[Actuator] = (),
        loads: Iterable[Load] = (),
        offsets: Iterable[Offset] = (),
        sensors: Iterable[Sensor] = (),
        actuator_scan_s: float | None = None,
        couplings: Iterable[Coupling] = (),
        bounds: Iterable[Bound] = (),
        step_s: float | None = None,
        transport: Transport | None = None,
    ) -> None:
        if not output_limits[0] <= output0 <= output_limits[1]:
            raise ValueError(
                f"output0 must lie within output_limits {output_limits} (got {output0}). Rest where it may stand."
            )
        for name, period_s in (("actuator_scan_s", actuator_scan_s), ("step_s", step_s)):
            if period_s is not None and not 0.0 < period_s < math.inf:
                raise ValueError(f"{name} must be positive (got {period_s}). Leave it out where nothing needs it.")
        self._actuators = copy.deepcopy(list(actuators))
        if actuator_scan_s is None and any(actuator.moves_by_itself for actuator in self._actuators):
            raise ValueError("actuator_scan_s is missing. Give the period of an actuator that moves on its own.")
        self._couplings = copy.deepcopy(list(couplings))
        self._bounds = list(bounds)
        if step_s is None and (self._couplings or self._bounds):
            raise ValueError("step_s is missing. Say in which steps couplings and bounds act.")
        self.plant = plant
        self._step_s = step_s if self._couplings or self._bounds else None
        self._motion = plant.motion()
        self._output0, self._pv0, self._limits = output0, pv0, output_limits
        self._loads = copy.deepcopy(list(loads))
        self._offsets = copy.deepcopy(list(offsets))
        self._sensors = copy.deepcopy(list(sensors))
        self._scan_s, self._scans, self._start_s = actuator_scan_s, 0, start_s
        self._t = self._acted_s = start_s
        self._output = self._position = self._delayed = output0
        self._transport = FixedDelay(plant.D) if transport is None else copy.deepcopy(transport)
        self._transport.rest(output0)
        for actuator in self._actuators:
            actuator.rest(output0)
        self._knot_s, self._state, self._fed = start_s, self._motion.rest, 0.0
        self._input = self._input_at(start_s)
        self._due_s = self._next_event_s()

    @property
    def t(self) -> float:
        """The present time, s."""
        return self._t

    @property
    def output(self) -> float:
        """The commanded output; assigning commands a new one at the present time."""
        return self._output

    @output.setter
    def output(self, value: float) -> None:
        if not math.isfinite(value):
            raise ValueError(f"output must be a number (got {value}). Command a number within the limits.")
        self._output = min(max(value, self._limits[0]), self._limits[1])
        if self._scan_s is None:
            self._act(self._t)
            self._due_s = self._next_event_s()
            self.advance(self._t)

    @property
    def position(self) -> float:
        """Position of the actuator, output units."""
        return self._position

    @property
    def pv(self) -> float:
        """The true PV, before the sensor."""
        pv = self._pv0 + self._motion.output(self._moved(self._t))
        for disturbance in self._offsets:
            pv += disturbance.offset(self._t)
        return pv

    def measure(self) -> float:
        """Return a reading of the PV; each call is a new sample of the noise."""
        reading = self.pv
        for sensor in self._sensors:
            reading = sensor.read(reading, self._t)
        return reading

    def advance(self, t: float) -> None:
        """Go on to time `t`, s.

        Raises
        ------
        ValueError
            `t` is not a finite time at or after the present one.
        """
        if not self._t <= t < math.inf:
            raise ValueError(f"t must not run backward from {self._t} s (got {t}). Advance to later times only.")
        while (event_s := self._due_s) <= t:
            if event_s == self._next_scan_s():
                self._scans += 1
                self._act(event_s)
            self._change_input(event_s)
            self._due_s = self._next_event_s()
        self._t = t

    def _next_scan_s(self) -> float:
        return math.inf if self._scan_s is None else self._start_s + (self._scans + 1) * self._scan_s

    def _next_event_s(self) -> float:
        load_s = min((load.next_change_s(self._knot_s) for load in self._loads), default=math.inf)
        step_s = math.inf if self._step_s is None else self._knot_s + self._step_s
        return min(self._transport.next_arrival_s(), load_s, self._next_scan_s(), step_s)

    def _act(self, t: float) -> None:
        position = self._output
        for actuator in self._actuators:
            position = actuator.act(position, t - self._acted_s)
        self._acted_s = t
        if position != self._position:
            self._position = position
            self._transport.send(t, position)

    def _change_input(self, t: float) -> None:
        self._delayed = self._transport.receive(t)
        self._state = self._moved(t)
        self._knot_s, self._input = t, self._input_at(t)

    def _moved(self, t: float) -> State:
        state = self._motion.move(self._state, self._input, t - self._knot_s)
        for bound in self._bounds:
            state = bound.keep(state)
        return state

    def _input_at(self, t: float) -> float:
        direct = self._delayed - self._output0 + sum(load.load(t) for load in self._loads)
        if self._couplings and self._step_s is not None:
            half_s = self._step_s / 2.0
            y = self._motion.output(self._motion.move(self._state, direct + self._fed, half_s))
            self._fed = sum(coupling.feed(t + half_s, direct, y) for coupling in self._couplings)
        return direct + self._fed
