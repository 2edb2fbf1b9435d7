"""Diagnosed effects between the controller's output and the process, for predictions of the closed loop.

    backlash             x follows u from `width`/2 away: x = min(max(x, u - width/2), u + width/2)
    stiction             |u - x| > band:  x <- u - sign(u - x) (band - jump),   else x stays
    saturation           x = min(max(u, low), high)
    rate_limit           -falling_rate_per_s <= x' <= rate_per_s, falling as fast as rising where not given;
                         x' = (u - x)/lag_s within these where a lag is given
    output_quantisation  x = step round(u/step)
    actuator_hold        x takes over u every `period_s` only
    static_nonlinearity  x = u + curvature u^2 (+ third u^3);   slope_at_rest u in place of u  where that is given
    direction_gain       x = u + (ratio - 1) max(u, 0)

`u`, `x` output units as deviation from the output at rest; `low`, `high` in output units. The effects and the names of
their sizes are those of `autotuner.core.diagnosis.effects`.

Invariants: an effect is a row; its state is in the function that a row creates, so every prediction
creates its own; an effect without a row (a disturbance, a sensor's) is omitted, and `predictable` reports these.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol

from autotuner.core.design.simulation.closed_loop import Actuator
from autotuner.core.effect_plugins import installed_effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MakeActuator = Callable[[], Actuator | None]
"""Creates the element between output and process, new for each prediction."""
SEATS = (0.0, 1.0, -1.0)
"""Initial positions of a valve with friction before a step: the middle and both ends of its band."""


class Named(Protocol):
    """An effect with its sizes, as a diagnosis gives it."""

    @property
    def name(self) -> str:
        """Name in the catalogue."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """Sizes."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Setting of an actuator: output at rest and sample time.

    Attributes
    ----------
    rest : float
        Output at rest, output units.
    sample_time_s : float
        Time between two moves of the controller, s.
    seat : float
        Position of a valve with friction in its band, -1 to 1.
    """

    rest: float
    sample_time_s: float
    seat: float = 0.0


def predictable(effects: Sequence[Named]) -> tuple[Named, ...]:
    """Return the effects that predictions support, in the order in which they act; those of plug-ins come last."""
    order = [*_ROWS, *(name for name, plugin in installed_effects().items() if plugin.element is not None)]
    return tuple(sorted((e for e in effects if e.name in order), key=lambda e: order.index(e.name)))


def has_friction(effects: Sequence[Named]) -> bool:
    """Return whether the response depends on the actuator's previous position."""
    return any(effect.name in FRICTION for effect in effects)


def actuator_of(effects: Sequence[Named], setting: Setting) -> Actuator | None:
    """Return the element between the commanded output and the process, at rest; None without any effect."""
    stages = [_element(effect, setting) for effect in predictable(effects)]
    if not stages:
        return None

    def act(output: float) -> float:
        for stage in stages:
            output = stage(output)
        return output

    return act


def _element(effect: Named, setting: Setting) -> Actuator:
    row = _ROWS.get(effect.name)
    if row is not None:
        return row(effect.parameters, setting)
    make = installed_effects()[effect.name].element
    assert make is not None  # noqa: S101 - those without are not predictable
    return make(effect.parameters)


def _backlash(sizes: Mapping[str, float], setting: Setting) -> Actuator:
    half = sizes["width"] / 2.0
    start = x = setting.seat * half

    def act(u: float) -> float:
        nonlocal x
        x = min(max(x, u - half), u + half)
        return x - start

    return act


def _stiction(sizes: Mapping[str, float], setting: Setting) -> Actuator:
    band, left = sizes["band"], sizes["band"] - sizes["jump"]
    start = x = setting.seat * left

    def act(u: float) -> float:
        nonlocal x
        if abs(u - x) > band:
            x = u - math.copysign(left, u - x)
        return x - start

    return act


def _curve(curve: Callable[[float], float]) -> Actuator:
    """Return a curve without memory, as deviation from rest."""
    at_rest = curve(0.0)
    return lambda u: curve(u) - at_rest


def _saturation(sizes: Mapping[str, float], setting: Setting) -> Actuator:
    low, high = sizes.get("low", -math.inf) - setting.rest, sizes.get("high", math.inf) - setting.rest
    return _curve(lambda u: min(max(u, low), high))


def _rate_limit(sizes: Mapping[str, float], setting: Setting) -> Actuator:
    rising, x = sizes["rate_per_s"] * setting.sample_time_s, 0.0
    falling = sizes.get("falling_rate_per_s", sizes["rate_per_s"]) * setting.sample_time_s
    covered = -math.expm1(-setting.sample_time_s / sizes["lag_s"]) if "lag_s" in sizes else 1.0

    def act(u: float) -> float:
        nonlocal x
        x += min(max(covered * (u - x), -falling), rising)
        return x

    return act


def _quantised(sizes: Mapping[str, float], _: Setting) -> Actuator:
    return _curve(lambda u: sizes["step"] * round(u / sizes["step"]))


def _held(sizes: Mapping[str, float], setting: Setting) -> Actuator:
    every, k, x = max(1, round(sizes["period_s"] / setting.sample_time_s)), -1, 0.0

    def act(u: float) -> float:
        nonlocal k, x
        k += 1
        x = u if k % every == 0 else x
        return x

    return act


def _polynomial(sizes: Mapping[str, float], _: Setting) -> Actuator:
    return _curve(
        lambda u: sizes.get("slope_at_rest", 1.0) * u + sizes["curvature"] * u * u + sizes.get("third", 0.0) * u**3
    )


def _direction_gain(sizes: Mapping[str, float], _: Setting) -> Actuator:
    return _curve(lambda u: u + (sizes["ratio"] - 1.0) * max(u, 0.0))


_ROWS: dict[str, Callable[[Mapping[str, float], Setting], Actuator]] = {
    "output_quantisation": _quantised,
    "actuator_hold": _held,
    "saturation": _saturation,
    "rate_limit": _rate_limit,
    "backlash": _backlash,
    "stiction": _stiction,
    "static_nonlinearity": _polynomial,
    "direction_gain": _direction_gain,
}
FRICTION = frozenset({"backlash", "stiction"})


def seats(effects: Sequence[Named], rest: float, sample_time_s: float) -> list[MakeActuator]:
    """Return makers of the actuator from everywhere it may stand before a step; one for an actuator without friction.

    Parameters
    ----------
    effects : sequence of Named
        What was found.
    rest : float
        Output at rest, output units.
    sample_time_s : float
        Time between two moves of the controller, s.
    """
    seats = SEATS if has_friction(effects) else SEATS[:1]
    return [partial(actuator_of, effects, Setting(rest, sample_time_s, seat)) for seat in seats]
