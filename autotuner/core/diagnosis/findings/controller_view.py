"""The process as a controller sees it: the diagnosed one, with the influence of the effects in the loop.

    direction_gain       K <- K max(1, ratio)             the side on which the gain is larger
    direction_dynamics   K <- K max(1, rise_over_fall)    the direction in which it moves faster
                         D <- D + the larger of its two lags
    actuator_hold        D <- D + period/2
    time_proportioning   D <- D + period/2
    rate_limit           D <- D + the lag of its positioner
    flow_delay           D <- D longest_over_first        the dead time at the lowest flow of the record
    dead_time_jump       D <- D max(1, later_over_first)  the longer of two dead times
    extra_lag            G <- G/(Tx s + 1);  D <- D + Tx  where no model holds the lag;  two by the half rule
    inverse_response     G <- G (1 - Z s);  refused as a second way with a time constant of its own
    slow_mode, recycle   omitted, where the slow mode, or what comes back, is small at the crossover of a loop; else
                         refused

Invariants: disturbances, the sensor, friction and limits change nothing here, for no gains remove them; an effect that
no process model can represent is refused, never omitted: gains that ignore an inverse response can be unstable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import TWO_LAGS
from autotuner.core.effect_plugins import installed_effects
from autotuner.core.identification.crossover_uncertainty import turn_over_frequency
from autotuner.core.model.process import (
    Fopdt,
    InverseResponse,
    InverseResponseUnderdamped,
    SopdtOverdamped,
    SopdtUnderdamped,
    frequency_response,
    model_from_dict,
    second_order,
    third_order,
)
from autotuner.core.quantiles import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.findings.result import FoundEffect
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

STRONGER = {"direction_gain": "ratio", "direction_dynamics": "rise_over_fall"}
"""Effects under which one direction has the larger gain, and the size that states by how much."""
LATER = {
    "actuator_hold": {"period_s": 0.5},
    "time_proportioning": {"period_s": 0.5},
    "direction_dynamics": {"rising_lag_s": 1.0, "falling_lag_s": 1.0},
    "rate_limit": {"lag_s": 1.0},
}
"""Effects that delay the output, and the share of each size that counts as dead time; of several the largest."""
LONGER = {"flow_delay": "longest_over_first", "dead_time_jump": "later_over_first"}
"""Effects under which the dead time is not always the same, and the size that states how much longer it becomes."""
ZERO, SLOW_MODE, RECYCLE, LAG = "inverse_response", "slow_mode", "recycle", "extra_lag"
HALF_RULE = 0.75
"""Share of the sum of two equal lags that one lag in their place has; the rest is dead time."""
SMALL = 0.5
"""Ratio of what a slow mode, or a recycle, adds at crossover to the response of the process, from which the process
alone is insufficient."""
ZEROS = {
    Fopdt: InverseResponse,
    SopdtOverdamped: InverseResponse,
    SopdtUnderdamped: InverseResponseUnderdamped,
}
"""Processes that a model with a zero holds."""
NUDGE = 1e-4
"""Relative step of the differences that carry errors from one set of parameters to another."""
OF_TWO_LAGS = {"T": "T1"}
"""A parameter of one lag by its name among two."""


@dataclass(frozen=True, slots=True)
class ControllerView:
    """A process as a controller sees it.

    Attributes
    ----------
    model : ProcessModel
        The process.
    covariance : array of float, shape (p, p), or None
        Covariance of its parameters, in their order.
    changes : tuple of str
        Changes of the process, in words.
    """

    model: ProcessModel
    covariance: FloatArray | None
    changes: tuple[str, ...] = ()


def controller_view(
    process: ProcessModel, covariance: FloatArray | None, effects: Sequence[FoundEffect]
) -> ControllerView | None:
    """Return the process as a controller sees it; None where no model holds it.

    Parameters
    ----------
    process : ProcessModel
        The process without the effects.
    covariance : array of float, shape (p, p), or None
        Of its parameters.
    effects : sequence of FoundEffect
        Its effects.
    """
    if any(BESIDE[e.name](process, e.parameters) >= SMALL for e in effects if e.name in BESIDE):
        return None
    stronger = max((e.parameters.get(STRONGER[e.name], 1.0) for e in effects if e.name in STRONGER), default=1.0)
    later_s = sum(_later_s(e.parameters, LATER[e.name]) for e in effects if e.name in LATER)
    longest = max((e.parameters[LONGER[e.name]] for e in effects if e.name in LONGER), default=1.0)
    view = _times(
        ControllerView(process, covariance), "K", stronger, "its gain is the larger one, {:.3g} times the other"
    )
    view = _times(
        view, "D", max(longest, 1.0), "its dead time is the longest of the record, {:.3g} times the first one"
    )
    view = _with_dead_time(view, later_s)
    for effect in effects:
        view = _with_lag(view, effect) if effect.name == LAG else view
    zero = next((e for e in effects if e.name == ZERO), None)
    last = view if zero is None else _with_zero(view, zero)
    for effect in effects:
        last = None if last is None else _with_plugin(last, effect)
    return last


def _with_plugin(view: ControllerView, effect: FoundEffect) -> ControllerView | None:
    """Return the process with an added effect; its covariance is that of the process without it."""
    plugin = installed_effects().get(effect.name)
    if plugin is None or plugin.controller_view is None:
        return view
    model = plugin.controller_view(view.model, effect.parameters)
    if model is None:
        return None
    same = type(model) is type(view.model)
    return ControllerView(model, view.covariance if same else None, (*view.changes, f"{effect.name} is in it"))


def _of_slow_mode(process: ProcessModel, sizes: Mapping[str, float]) -> float:
    """Return the response of a slow mode, which has `share` of the whole static gain, over the process's."""
    share, w = sizes.get("share", 0.0), turn_over_frequency(process)
    if share >= 1.0:
        return math.inf
    slow = share / (1.0 - share) * process.K / (1.0 + 1j * w * sizes.get("time_constant_s", 0.0))
    return abs(slow) / abs(complex(frequency_response(process, np.array([w]))[0]))


def _of_recycle(process: ProcessModel, sizes: Mapping[str, float]) -> float:
    """Return the most that what comes back adds to the response of the process: all of it in phase, again and again."""
    w = turn_over_frequency(process)
    back = sizes.get("share", 0.0) * abs(complex(frequency_response(process, np.array([w]))[0]) / process.K)
    return back / (1.0 - back) if back < 1.0 else math.inf


BESIDE = {SLOW_MODE: _of_slow_mode, RECYCLE: _of_recycle}
"""Effects that no model has, and what they add to the response of the process, over it."""


def _later_s(sizes: Mapping[str, float], shares: Mapping[str, float]) -> float:
    return max((share * sizes.get(name, 0.0) for name, share in shares.items()), default=0.0)


def _times(view: ControllerView, name: str, factor: float, change: str) -> ControllerView:
    """Return the process with one of its parameters multiplied, at least by one."""
    if factor <= 1.0:
        return view
    values = view.model.parameters()
    scale = np.array([factor if one == name else 1.0 for one in values])
    covariance = None if view.covariance is None else view.covariance * np.outer(scale, scale)
    model = replace(view.model, **{name: values[name] * factor})  # type: ignore[type-var]
    return ControllerView(model, covariance, (*view.changes, change.format(factor)))


def _with_dead_time(view: ControllerView, later_s: float) -> ControllerView:
    if later_s <= 0.0:
        return view
    model = replace(view.model, D=view.model.D + later_s)  # type: ignore[type-var]
    return ControllerView(
        model, view.covariance, (*view.changes, f"{later_s:.3g} s of its dead time are the actuator's")
    )


def _with_lag(view: ControllerView, effect: FoundEffect) -> ControllerView:
    """Return the process with a further lag, whose error is assumed independent of the others.

    Two of them, equal, are one and a half, and half of one as dead time (half rule; Skogestad, J. Process Control 13).
    """
    names, lag_s = list(view.model.parameters()), effect.parameters["time_constant_s"]
    share = HALF_RULE if effect.form == TWO_LAGS else 1.0

    def behind(x: FloatArray) -> ProcessModel:
        p, together_s = dict(zip(names, x[:-1].tolist(), strict=True)), float(x[-1])
        return _behind_a_lag(view.model, {**p, "D": p["D"] + (1.0 - share) * together_s}, share * together_s)

    x = np.array([*view.model.parameters().values(), lag_s])
    model = behind(x)
    moved = [behind(x + step) for step in np.diag(NUDGE * np.maximum(np.abs(x), lag_s))]
    covariance = None
    if view.covariance is not None and all(type(one) is type(model) for one in moved):
        low, high = effect.interval95.get("time_constant_s", (lag_s, lag_s))
        wide = np.zeros((x.size, x.size))
        wide[:-1, :-1], wide[-1, -1] = view.covariance, ((high - low) / 2.0 / NORMAL_95) ** 2
        here = np.array(list(model.parameters().values()))
        J = np.column_stack([np.array(list(one.parameters().values())) - here for one in moved])
        J /= NUDGE * np.maximum(np.abs(x), lag_s)
        covariance = J @ wide @ J.T
    return ControllerView(model, covariance, (*view.changes, f"a further lag of {lag_s:.3g} s is in it"))


def _behind_a_lag(kind: ProcessModel, p: Mapping[str, float], lag_s: float) -> ProcessModel:
    """Return a process of a kind, with some parameters, with a lag; as dead time where no model represents the lag."""
    if isinstance(kind, Fopdt):
        return second_order(p["K"], p["T"] * lag_s, p["T"] + lag_s, p["D"])
    if isinstance(kind, SopdtOverdamped):
        return third_order(p["K"], p["T1"] * p["T2"], p["T1"] + p["T2"], lag_s, p["D"])
    if isinstance(kind, SopdtUnderdamped):
        return third_order(p["K"], p["m"], p["n"], lag_s, p["D"])
    return replace(kind, **{**p, "D": p["D"] + lag_s})  # type: ignore[type-var]


def _with_zero(view: ControllerView, effect: FoundEffect) -> ControllerView | None:
    """Return the process with its zero, whose error is assumed independent of the others."""
    process, Z = view.model, effect.parameters.get("Z", 0.0)
    kind = ZEROS.get(type(process))
    if kind is None or Z <= 0.0:
        return None
    names = {OF_TWO_LAGS.get(name, name): name for name in process.parameters()}
    numbers = {new: process.parameters()[old] for new, old in names.items()}
    model = model_from_dict({"T2": 0.0, **numbers, "Z": Z} if kind is InverseResponse else {**numbers, "Z": Z})
    low, high = effect.interval95.get("Z", (Z, Z))
    covariance = (
        None if view.covariance is None else _widened(view, model, names, ((high - low) / 2.0 / NORMAL_95) ** 2)
    )
    return ControllerView(model, covariance, (*view.changes, f"it answers the wrong way first, Z {Z:.3g} s"))


def _widened(view: ControllerView, model: ProcessModel, names: Mapping[str, str], variance: float) -> FloatArray:
    """Return the covariance of the parameters with a zero; those that the process did not have are exact."""
    old, new = list(view.model.parameters()), list(model.parameters())
    take = np.array([[float(names.get(row) == column) for column in old] for row in new])
    wide: FloatArray = take @ view.covariance @ take.T
    wide[new.index("Z"), new.index("Z")] = variance
    return wide
