"""A stepped plant from plain values, as configuration files and command lines give them."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields
from typing import TYPE_CHECKING, Any, Final

from autotuner_sim import effects
from autotuner_sim.plants import PLANTS
from autotuner_sim.stepped import SteppedPlant

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Effect = tuple[str, "Mapping[str, float | tuple[float, ...]]"]
"""Name of the effect, and its parameters by name."""

EFFECTS: Final[dict[str, tuple[str, type]]] = {
    "backlash": ("actuators", effects.Backlash),
    "stiction": ("actuators", effects.Stiction),
    "saturation": ("actuators", effects.Saturation),
    "rate_limit": ("actuators", effects.RateLimit),
    "output_quantisation": ("actuators", effects.OutputQuantisation),
    "direction_gain": ("actuators", effects.DirectionGain),
    "load_step": ("loads", effects.LoadStep),
    "drift": ("offsets", effects.Drift),
    "sends": ("actuators", effects.Sends),
    "hears": ("offsets", effects.Hears),
}
"""Location and class of each effect, by its name in the options."""

ACTUATOR_SCAN_S: Final = 0.02
"""Scan of the actuators when one of them moves with time."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a plant or an effect: its name, whether it is a list of numbers, whether it may be left out."""

    name: str
    many: bool
    optional: bool


def parameters_of(kind: type) -> tuple[Parameter, ...]:
    """Return the parameters of a plant's or an effect's class."""
    return tuple(Parameter(f.name, "tuple" in str(f.type), f.default is not MISSING) for f in fields(kind) if f.init)


def build_plant(
    structure: str,
    parameters: Mapping[str, float | tuple[float, ...]],
    *,
    output0: float = 0.0,
    pv0: float = 0.0,
    noise: float = 0.0,
    quantisation: float = 0.0,
    seed: int = 0,
    limits: tuple[float, float] = (-math.inf, math.inf),
    with_effects: Iterable[Effect] = (),
) -> SteppedPlant:
    """Return a plant at rest at time 0.

    Parameters
    ----------
    structure : str
        A key of `plants.PLANTS`.
    parameters : mapping
        Its parameters by name.
    output0, pv0 : float
        The rest point.
    noise, quantisation : float
        Standard deviation of the reading's noise and its resolution, PV units; 0 for none.
    seed : int
        Seed of the noise.
    limits : tuple of float
        Lowest and highest output.
    with_effects : iterable of (str, mapping)
        Effects by name, a key of `EFFECTS`, with their parameters.

    Raises
    ------
    ValueError
        A parameter that cannot be; names it.
    """
    placed: dict[str, list[Any]] = {"actuators": [], "loads": [], "offsets": []}
    for name, values in with_effects:
        place, kind = EFFECTS[name]
        placed[place].append(kind(**values))
    sensors: list[effects.Sensor] = [effects.Noise(noise, seed)] if noise else []
    if quantisation:
        sensors.append(effects.Quantisation(quantisation))
    moving = any(isinstance(actuator, effects.RateLimit) for actuator in placed["actuators"])
    return SteppedPlant(
        PLANTS[structure](**parameters),
        output0=output0,
        pv0=pv0,
        output_limits=limits,
        sensors=sensors,
        actuator_scan_s=ACTUATOR_SCAN_S if moving else None,
        actuators=placed["actuators"],
        loads=placed["loads"],
        offsets=placed["offsets"],
    )
