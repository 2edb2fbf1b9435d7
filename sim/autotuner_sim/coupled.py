"""Two loops that disturb each other: each output moves both PVs.

y1 = pv0_1 + G11 u1 + G12 u2,   y2 = pv0_2 + G21 u1 + G22 u2

first, second = coupled_plants(output0=(40.0, 30.0), pv0=(60.0, 50.0))
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

from autotuner_sim.effects.cross_paths import Hears, Sends
from autotuner_sim.plants.linear import Fopdt, SopdtOverdamped
from autotuner_sim.stepped import SteppedPlant

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner_sim.effects.protocols import Load, Sensor
    from autotuner_sim.plants.linear import Plant

TWO_HEATERS = (Fopdt(0.65, 130.0, 15.0), Fopdt(0.55, 140.0, 15.0))
BOARD = (SopdtOverdamped(0.25, 130.0, 40.0, 15.0), SopdtOverdamped(0.25, 130.0, 40.0, 15.0))
"""Gain, degC per per cent, and lags, s, from each heater to the other sensor, as of a Temperature Control Lab."""
_numbers = itertools.count(-1, -1)


def coupled_plants(
    own: tuple[Plant, Plant] = TWO_HEATERS,
    cross: tuple[SopdtOverdamped, SopdtOverdamped] = BOARD,
    *,
    output0: tuple[float, float] = (0.0, 0.0),
    pv0: tuple[float, float] = (0.0, 0.0),
    limits: tuple[float, float] = (-math.inf, math.inf),
    sensors: tuple[Iterable[Sensor], Iterable[Sensor]] = ((), ()),
    loads: tuple[Iterable[Load], Iterable[Load]] = ((), ()),
) -> tuple[SteppedPlant, SteppedPlant]:
    """Return the two loops at rest.

    Parameters
    ----------
    own : tuple of Plant
        `G11` and `G22`.
    cross : tuple of SopdtOverdamped
        `G12`, from the second output to the first PV, and `G21`.
    output0, pv0 : tuple of float
        The rest point of each loop, output and PV units.
    limits : tuple of float
        A commanded output outside of these is held at the nearer one.
    sensors, loads : tuple of iterables
        Sensor effects on each PV, and disturbances of each process.
    """
    wires = (float(next(_numbers)), float(next(_numbers)))
    first, second = (
        SteppedPlant(
            own[i],
            output0=output0[i],
            pv0=pv0[i],
            output_limits=limits,
            sensors=sensors[i],
            loads=loads[i],
            actuators=[Sends(wires[i])],
            offsets=[_heard(wires[1 - i], cross[i], output0[1 - i])],
        )
        for i in (0, 1)
    )
    return first, second


def _heard(wire: float, path: SopdtOverdamped, output0: float) -> Hears:
    return Hears(wire, path.K, path.T1, path.T2, path.D, output0)
