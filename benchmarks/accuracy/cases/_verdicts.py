"""What a diagnosis is worth, given the truth: names, errors of model and effect, and whether the misfit was visible.

    base residual   best linear model of the plant's own kind on the whole record, by its exact response
                    y(t) = offset + sum over the moves du_i of the output of du_i s(t - t_i - D),  s = step response

fitted here by `scipy.optimize.least_squares`, so that what counts as visible does not depend on who is judged.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares

from benchmarks.accuracy.cases._scenes import lag_of

VISIBLE = 1.5
"""Base residual over noise from which a diagnosis is asked to name the effect."""
FLOOR = 1e-3
"""Stands for the noise of a record without noise, in spreads of the PV."""
FAR_OFF = 1e3
"""Stands for a residual that is no number, in ranges of the PV: the search goes elsewhere."""
SURE = 0.8
"""Confidence from which a wrong name counts as confidently wrong."""


def step_response(kind, shape, t):
    """Return the unit-gain step response at `t` >= 0; `shape` is (T1, T2) or (m, n)."""
    t = np.maximum(t, 0.0)
    if kind == "underdamped":
        m, n = shape
        decay = n / (2.0 * m)
        turn = np.sqrt(complex(1.0 / m - decay**2)) + 1e-12
        return np.real(1.0 - np.exp(-decay * t) * (np.cos(turn * t) + decay / turn * np.sin(turn * t)))
    slow, fast = shape
    if fast < 1e-3 * slow:
        return -np.expm1(-t / slow)
    if abs(slow - fast) < 1e-4 * slow:
        fast = slow * (1.0 - 1e-4)
    return 1.0 - (slow * np.exp(-t / slow) - fast * np.exp(-t / fast)) / (slow - fast)


def residual_of(recording, kind, K, shape, D):
    """Return PV minus offset minus response."""
    moved = np.flatnonzero(np.diff(recording.output)) + 1
    sizes, moments = np.diff(recording.output)[moved - 1], recording.t[moved]
    y = np.zeros(recording.t.size)
    for size, moment in zip(sizes, moments, strict=True):
        after = recording.t > moment + D
        y[after] += K * size * step_response(kind, shape, recording.t[after] - moment - D)
    left = recording.pv - y
    return left - left.mean()


def base_residual(recording, scene, declared=None):
    """Return the root mean square residual of the best linear model, or of the declared one, PV units."""
    kind, plant = scene.kind, declared or scene.plant
    if declared is not None:
        shape = (plant.m, plant.n) if kind == "underdamped" else (getattr(plant, "T1", lag_of(plant)), 0.0)
        shape = (plant.T1, plant.T2) if hasattr(plant, "T1") else shape
        return float(np.sqrt(np.mean(residual_of(recording, kind, plant.K, shape, plant.D) ** 2)))
    first = (plant.m, plant.n) if kind == "underdamped" else (plant.T, 0.02 * plant.T)
    start = np.log([plant.K, *first, max(plant.D, 0.01 * lag_of(plant))])

    def left(theta):
        K, one, other, D = np.exp(theta)
        shape = (one, other) if kind == "underdamped" else (max(one, other), min(one, other))
        with np.errstate(over="ignore", invalid="ignore"):
            found = residual_of(recording, kind, K, shape, D)
        return np.where(np.isfinite(found), found, FAR_OFF * np.ptp(recording.pv))

    fit = least_squares(left, start, bounds=(start - 5.0, start + 5.0), diff_step=1e-4, max_nfev=25)
    return float(np.sqrt(2.0 * fit.cost / recording.t.size))


def parameters_of(model):
    """Return gain, sum of lags and dead time of a mapping of the report, or None."""
    if not model or model.get("K") is None:
        return None
    values = model.get("parameters", model)
    try:
        lag_s = lag_of({name: values.get(name) for name in ("T", "T1", "T2", "n")})
    except TypeError:
        return None
    return (values["K"], lag_s or 0.0, values.get("D", 0.0)) if lag_s is not None else None


def worst_error(model, plant):
    """Return the largest relative error of gain, lag and dead time; infinite when the structure has other ones."""
    found = parameters_of(model)
    if found is None or "Z" in model or model.get("structure") in {"integrating", "unstable_fopdt"}:
        return math.inf
    truth = (plant.K, lag_of(plant), plant.D)
    scale = (plant.K, max(truth[1], 0.2 * plant.D), max(plant.D, 0.1 * truth[1]))
    return max(abs(a - b) / c for a, b, c in zip(found, truth, scale, strict=True))


@dataclass(frozen=True)
class Judged:
    """One diagnosis against the truth."""

    effect: str
    label: str
    textbook: bool
    kind: str
    severity: int
    decibel: float
    experiment: str
    names: tuple
    alike: tuple
    verdict: str
    confidence: float
    right: tuple
    base: float
    held_before: float
    held_after: float
    before: float
    after: float
    inside: dict = field(default_factory=dict)
    seconds: float = 0.0
    samples: int = 0
    notes: tuple = ()
    saved: str = ""
    each_visible: bool = False

    @property
    def visible(self):
        return self.base > VISIBLE

    @property
    def first_right(self):
        """The right effect first, or in the class that is stated with the first."""
        return bool(self.names) and bool({self.names[0], *self.alike} & set(self.right))

    @property
    def only_right(self):
        return len(self.names) == 1 and self.first_right

    @property
    def wrong(self):
        return bool(self.names) and not self.first_right

    @property
    def confidently_wrong(self):
        return self.wrong and self.confidence >= SURE


def judge(case, truth, diagnosis, base, sigma, seconds, samples):
    """Return the judgement; `diagnosis` is its JSON form, `sigma` what counts as noise."""
    effects = diagnosis["effects"]
    error = diagnosis["error"].get("held_out", {})
    plant = case.scene.plant
    model = diagnosis["model"]
    own = [effect for effect in effects if effect["name"] in truth.right[:1]]
    return Judged(
        effect=case.name,
        label=case.label,
        textbook=case.textbook,
        kind=case.scene.kind,
        severity=case.severity,
        decibel=case.decibel,
        experiment=case.experiment,
        names=tuple(effect["name"] for effect in effects),
        alike=tuple(effects[0]["indistinguishable"]) if effects else (),
        verdict=diagnosis["verdict"],
        confidence=(effects[0]["confidence"] or 0.0) if effects else 0.0,
        right=truth.right,
        base=base / sigma,
        held_before=_number(error.get("before")) / sigma,
        held_after=_number(error.get("after")) / sigma,
        before=worst_error(model.get("before"), plant),
        after=worst_error(model.get("after"), plant),
        inside=_inside(own[0]["interval95"], truth.sizes) if own else {},
        seconds=seconds,
        samples=samples,
        notes=tuple(diagnosis["notes"]),
    )


def _number(value):
    return math.nan if value is None else value


def _inside(intervals, sizes):
    """Return, for each size that has an interval, whether that holds the truth."""
    known = {name: intervals[name] for name in sizes if intervals.get(name) and None not in intervals[name]}
    return {name: low <= sizes[name] <= high for name, (low, high) in known.items()}
