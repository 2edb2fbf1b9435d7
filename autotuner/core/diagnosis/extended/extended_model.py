"""A process model extended by effects, separable in what is searched for and what is solved for.

    PV = columns(theta) c + noise

`theta` holds the logarithms of the process's time constants, its dead time in units of `unit_s`, then the numbers that
the effects search for. Gains, offset and all sizes, `c`, are coefficients of columns and are solved for (see
`fitting`). With autoregressive noise, PV and columns are those after the filter that makes it white, and the residual
is that of prediction (see `ar_noise`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Searched, View
from autotuner.core.estimation.noise.ar_noise import Coloured
from autotuner.core.model.zoh_input import HeldInput, unit_step

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.estimation.noise.ar_noise import Memory
    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.model.structures import Structure

SHORTEST, LONGEST = 0.05, 30.0
"""Bounds of time constants: in sample intervals, and in lengths of the recording."""
NO_GAIN = 1e-100
"""Gain in place of 0, PV per output: sizes over it, or over its third power, are endless, but are numbers."""
SAME_MISFIT = 1e-6
"""Relative difference of two misfits that counts as zero: far more than rounding, which depends on the
processor, and far less than the difference between explanations."""


@dataclass(frozen=True, eq=False)
class Extended:
    """A structure with effects on a recording.

    Attributes
    ----------
    dataset : Dataset
        The recording.
    structure : Structure
        The process.
    effects : tuple of Effect
        Additional effects, actuator effects in their order from output to process.
    rows : array of int
        Samples that are fitted.
    background : tuple of str
        What the PV does besides.
    fixed : tuple of float or None
        Process part of `theta` where a declared model is held; gain and offset are solved for all the same.
    memory : Memory or None
        What the noise remembers from sample to sample; None where it is taken as white.
    """

    dataset: Dataset
    structure: Structure
    effects: tuple[Effect, ...]
    rows: IntArray
    background: tuple[str, ...] = ("offset",)
    fixed: tuple[float, ...] | None = None
    memory: Memory | None = None

    @property
    def unit_s(self) -> float:
        """Unit of the dead time in `theta`, s."""
        return self.dataset.span_s / 100.0

    @cached_property
    def searched(self) -> tuple[Searched, ...]:
        """All that is searched for, the process's part first."""
        interval, span = self.dataset.data.interval_s, self.dataset.span_s
        low, high = math.log(SHORTEST * interval), math.log(LONGEST * span)
        shape = [Searched(name, low, high) for name in self.structure.shape]
        delay = Searched("D", 0.0, 0.5 * span / self.unit_s)
        if self.fixed is not None:
            shape = [Searched(s.name, v, v) for s, v in zip(shape, self.fixed, strict=False)]
            delay = Searched("D", self.fixed[-1], self.fixed[-1])
        return (*shape, delay, *(s for effect in self.effects for s in effect.searched))

    def with_effect(self, effect: Effect) -> Extended:
        """Return the model with one effect more, at its place in the row from output to PV."""
        return replace(self, effects=tuple(sorted((*self.effects, effect), key=lambda e: e.rank)))

    def split(self, theta: FloatArray) -> tuple[list[float], float, list[list[float]]]:
        """Return the shape, the dead time, s, and each effect's values."""
        size = len(self.structure.shape)
        shape = np.exp(theta[:size]).tolist()
        values, at = [], size + 1
        for effect in self.effects:
            values.append(theta[at : at + len(effect.searched)].tolist())
            at += len(effect.searched)
        return shape, float(theta[size]) * self.unit_s, values

    def view(self, theta: FloatArray, rows: IntArray) -> View:
        """Return the view of the effects at some samples."""
        shape, D, values = self.split(theta)
        dataset = self.dataset
        held = dataset.data.held
        for effect, p in zip(self.effects, values, strict=True):
            if effect.position is not None:
                held = _positioned(effect, held, tuple(p), dataset)
            if effect.transport is not None:
                held = effect.transport(held, p, D, dataset)
        motion = self.structure.motion(shape, dataset.span_s)
        with_load = [(e.load, p) for e, p in zip(self.effects, values, strict=True) if e.load is not None]
        loads = [load(p, dataset) for load, p in with_load]
        entering = _with_loads(held, loads, D) if loads else None
        return View(dataset, dataset.data.t[rows], D, motion, held, entering)

    @cached_property
    def computed(self) -> IntArray:
        """The samples at which the PV is simulated for a fit: with a memory, also those between the fitted ones."""
        return self.rows if self.memory is None else np.arange(self.rows[0], self.rows[-1] + 1)

    @cached_property
    def target(self) -> FloatArray:
        """The PV that is fitted."""
        return self.whitened(self.dataset.data.pv[self.computed])

    def whitened(self, values: FloatArray) -> FloatArray:
        """Return columns of all computed samples, or a single one, as they are fitted: their noise white."""
        noise = self.noise
        return values if noise is None else self.of_fitted(noise.whitened(values))

    @cached_property
    def noise(self) -> Coloured | None:
        """The noise with a memory, at the computed samples; None where it is white."""
        if self.memory is None:
            return None
        dataset, rows = self.dataset, self.computed
        counts = (dataset.fitted | dataset.held_out)[rows].astype(float)
        return Coloured.of(self.memory, dataset.data.t[rows], counts)

    def of_fitted(self, values: FloatArray) -> FloatArray:
        """Return of values at all computed samples those at the fitted ones."""
        result: FloatArray = values[self.rows - self.rows[0]]
        return result

    def columns(self, theta: FloatArray, rows: IntArray) -> tuple[FloatArray, list[int]]:
        """Return the columns at some samples, and how many of them each effect added."""
        return self.columns_of(self.view(theta, rows), theta)

    def columns_of(
        self, view: View, theta: FloatArray, background: FloatArray | None = None
    ) -> tuple[FloatArray, list[int]]:
        """Return the same of a view at `theta`; the background is given where the process is as it was."""
        _, _, values = self.split(theta)
        columns, added = self._response(view, values), self._added(view, values)
        background_columns = self._background(view) if background is None else [background]
        return np.column_stack([*columns, *(c for of in added for c in of), *background_columns]), list(map(len, added))

    def columns_at(self, thetas: Sequence[FloatArray]) -> list[list[FloatArray]]:
        """Return the columns at each `theta` of one process but for the background: at once where inputs move alike."""
        views = [self.view(theta, self.rows) for theta in thetas]
        values = [self.split(theta)[2] for theta in thetas]
        responses = self._responses(views, values)
        return [
            [*response, *(c for of in self._added(view, p) for c in of)]
            for view, p, response in zip(views, values, responses, strict=True)
        ]

    def _added(self, view: View, values: Sequence[Sequence[float]]) -> list[list[FloatArray]]:
        """Return the columns that each effect adds."""
        return [
            list(effect.columns(view, p)) if effect.columns is not None else []
            for effect, p in zip(self.effects, values, strict=True)
        ]

    def _responses(self, views: Sequence[View], values: Sequence[Sequence[Sequence[float]]]) -> list[list[FloatArray]]:
        """Return the response to the output in each view of one process."""
        first, times = views[0], views[0].input.times
        changed = any(effect.response is not None for effect in self.effects)
        if changed or any(view.input.times is not times for view in views):
            return list(map(self._response, views, values))
        together = HeldInput(times, np.array([view.input.levels for view in views]))
        return list(map(list, zip(*first.motion.forced(together, first.t - first.delay_s)[0], strict=True)))

    def _response(self, view: View, values: Sequence[Sequence[float]]) -> list[FloatArray]:
        for effect, p in zip(self.effects, values, strict=True):
            if effect.response is not None:
                return [effect.response(view, p)]
        return list(view.motion.forced(view.input, view.t - view.delay_s)[0])

    def _background(self, view: View) -> list[FloatArray]:
        columns = [np.ones(view.t.size)]
        if "drift" in self.background:
            columns.append(view.t / self.dataset.span_s)
        if "state" in self.background:
            columns += _from_state(view)
        return columns


def _with_loads(held: HeldInput, loads: Sequence[HeldInput], delay_s: float) -> HeldInput:
    """Return an input with loads that the dead time does not hold up: those at the start precede the first output."""
    early = [load.shifted(np.array(-delay_s)) for load in loads]
    first = min(float(held.times[0]), *(float(load.times[1:].min(initial=0.0)) for load in early))
    times = np.unique(np.concatenate([[first], held.times, *(load.times[1:] for load in early)]))
    level = held.at(times)
    for load in early:
        level = level + replace(load, times=np.append(first, load.times[1:])).at(times)
    return HeldInput(np.append(first, times), np.append(0.0, level))


@lru_cache(maxsize=32)
def _positioned(effect: Effect, held: HeldInput, values: tuple[float, ...], dataset: Dataset) -> HeldInput:
    """Return the input after an effect; cached, because slopes by the process's own numbers need it again."""
    assert effect.position is not None  # noqa: S101 - asked before
    return effect.position(held, values, dataset)


def _from_state(view: View) -> list[FloatArray]:
    """Return the motions from an initial state, and the answer to an input before the record; again at each restart."""
    starts = np.array(view.dataset.restarts_s)
    since = view.t - starts[np.searchsorted(starts, view.t, side="right") - 1]
    return [*view.motion.free(since), view.motion.forced(unit_step(0.0), since - view.delay_s)[0][0]]


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Result of a search.

    Attributes
    ----------
    problem : Extended
        What was fitted.
    theta : array of float
        What was searched for.
    linear : array of float
        What was solved for: gains, sizes of the effects, offset.
    counts : list of int
        Sizes that each effect has.
    residual : array of float
        Measured minus simulated at the fitted samples, PV.
    """

    problem: Extended
    theta: FloatArray
    linear: FloatArray
    counts: list[int]
    residual: FloatArray

    @property
    def mean_square(self) -> float:
        """Mean square of the residual, PV squared."""
        return float(self.residual @ self.residual) / self.residual.size

    @property
    def rms(self) -> float:
        """Root mean square of the residual, PV."""
        return math.sqrt(self.mean_square)

    @property
    def misfit(self) -> float:
        """Mean square of the residual, plus that of rounding, PV squared: the ranking of fits."""
        return self.mean_square + self.problem.dataset.floor**2

    @property
    def size(self) -> int:
        """Number of everything that was fitted."""
        held = 0 if self.problem.fixed is None else len(self.problem.fixed)
        return int(self.theta.size + self.linear.size) - held

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.problem.effects)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names and forms of the effects."""
        return tuple(effect.key for effect in self.problem.effects)

    @property
    def price(self) -> float:
        """Additional penalties of the effects besides their parameters."""
        return sum(effect.price for effect in self.problem.effects)

    def process(self) -> ProcessModel:
        """Return the process model; raises `InputError` where none exists."""
        structure = self.problem.structure
        shape, D, _ = self.problem.split(self.theta)
        return structure.model(shape, self.linear[: structure.gains].tolist(), D)

    def on(self, dataset: Dataset) -> Fitted:
        """Return the same numbers on another part of the record, in the same units."""
        return replace(self, problem=replace(self.problem, dataset=dataset))

    def simulated(self, rows: IntArray) -> FloatArray:
        """Return the simulated PV at some samples, as deviation from the dataset's `pv0`."""
        dataset = self.problem.dataset
        result: FloatArray = np.clip(
            self.problem.columns(self.theta, rows)[0] @ self.linear, dataset.bottom, dataset.top
        )
        return result

    def reported_names(self) -> list[str]:
        """Return the names of the effects as they are reported: that of a free form follows from its shape."""
        at = self.problem.structure.gains
        names = []
        for effect, count in zip(self.problem.effects, self.counts, strict=True):
            names.append(effect.reads_as(self.linear[at : at + count].tolist()) if effect.reads_as else effect.name)
            at += count
        return names

    def is_meaningful(self) -> bool:
        """Return whether the numbers of every effect agree with its name."""
        shape, _, values = self.problem.split(self.theta)
        at, gain = self.problem.structure.gains, float(self.linear[0])
        for effect, p, count in zip(self.problem.effects, values, self.counts, strict=True):
            if effect.means is not None and not effect.means(p, self.linear[at : at + count].tolist(), gain, shape):
                return False
            at += count
        return True

    def sizes(self) -> list[dict[str, float]]:
        """Return the reported sizes of each effect, in engineering units."""
        return sizes_at(self.problem, self.theta, self.linear, self.counts)


Ranked = TypeVar("Ranked")


def without_rounding(
    items: Iterable[Ranked],
    misfit: Callable[[Ranked], float],
    tie: Callable[[Ranked], tuple[object, ...]] | None = None,
) -> list[Ranked]:
    """Return items by their misfit, the lowest first, in an order that does not depend on how sums are rounded.

    Misfits that lie within `SAME_MISFIT` of each other are the same, so are those with others in between that do.

    Parameters
    ----------
    items : iterable
        What is put in order.
    misfit : callable
        Key of the ranking: a misfit, or a criterion based on it. NaN comes last.
    tie : callable, optional
        What decides where that is the same; after it, or without it, the one that comes first in `items`.
    """
    given = list(items)
    values = [math.inf if math.isnan(value) else value for value in map(misfit, given)]
    order = sorted(range(len(given)), key=values.__getitem__)
    apart = (not math.isclose(values[a], values[b], rel_tol=SAME_MISFIT) for a, b in pairwise(order))
    levels = accumulate(apart, initial=0)
    keys = [(level, () if tie is None else tie(given[k]), k) for level, k in zip(levels, order, strict=False)]
    return [given[k] for _, _, k in sorted(keys)]


def apart(
    order: Iterable[Ranked], distance: Callable[[Ranked, Ranked], float], least: float, most: int
) -> list[Ranked]:
    """Return the first of an order that are at least so far from each other, `most` at most."""
    found: list[Ranked] = []
    for k in order:
        if all(distance(k, other) >= least for other in found):
            found.append(k)
        if len(found) == most:
            break
    return found


def plainness(candidate: Fitted) -> tuple[float, tuple[int, ...], tuple[str, ...]]:
    """Return the tie-break of explanations with the same misfit: number of parameters and penalty, then place and name.

    A limit of the output comes before a curve of the valve: what is nearer to the output is looked at first.
    """
    effects = candidate.problem.effects
    return candidate.size + candidate.price, tuple(e.rank for e in effects), candidate.keys


def closest_first(fits: Iterable[Fitted]) -> list[Fitted]:
    """Return fits by their misfit, the plainer one first where that is the same."""
    return without_rounding(fits, lambda f: f.misfit, plainness)


def sizes_at(problem: Extended, theta: FloatArray, linear: FloatArray, counts: Sequence[int]) -> list[dict[str, float]]:
    """Return the reported sizes of the effects at any `theta` and `linear`."""
    _, _, values = problem.split(theta)
    at = problem.structure.gains
    gain = float(linear[0]) or NO_GAIN
    sizes = []
    for effect, p, count in zip(problem.effects, values, counts, strict=True):
        sizes.append(dict(effect.sizes(p, linear[at : at + count].tolist(), gain)))
        at += count
    return sizes
