"""Updates at uneven times of an actuator in a loop.

    v(t) = u(tau_i),   tau_i <= t < tau_{i+1}
    minimise over the tau_i   sum_k (pv_k - K y_k - background)^2 / s^2 + 2 ln(N) * (number of updates)
    x(t + h/4) = M x(t) + b v(t),   y = c'x

`u` output, `v` position, `x` state of the process alone, `K` its gain, `h` sample interval, `N` samples, `s` standard
deviation of what is left. A controller moves its output at every sample, so that no move is late by itself (as in
`update_jitter`): at each quarter of a sample, the actuator holds its position or takes the output over. Of all
sequences of these, the cheapest ones are carried on from sample to sample (the M-algorithm: Anderson and Mohan, IEEE
Trans. Commun. 32, 1984).

An update that was missed shows within a few samples, so that a few hundred sequences are enough. The cost of an update
is that of two numbers by the criterion (see `fit_context`): its time, and that there is one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.update_jitter import UNIFORM
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, Seen, View
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.quantiles import NORMAL_95
from autotuner.core.signals.noise import noise_sigma

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray, IntArray

PARTS = 4
"""Parts of a sample at which the output may be taken over."""
CARRIED = 300
"""Sequences that are carried on."""
MOST_STEPS, UNSEEN = 5, 1e-3
"""Gauss-Newton steps for times that are known to an eighth of a sample, and relative singular value from which a time
stays: the output hardly moved."""
OF_A_SPREAD = math.sqrt(0.2)
"""Relative standard error of the standard deviation of uniform values, times the root of their number."""
WITHIN = 1e-3
"""Least distance of an update from the end of its sample, in samples: there, the next output begins."""


def updates_in_loop(seen: Seen, sigma: float) -> FloatArray:
    """Return the likeliest times of updates, in samples, the earliest first; the process is as it is.

    Parameters
    ----------
    seen : Seen
        The process, with a single response to the output, and the samples that the updates are to follow.
    sigma : float
        Standard deviation of what is left, PV.
    """
    data, interval = seen.view.dataset.data, seen.view.dataset.data.interval_s
    count = int(seen.rows[-1]) + 1
    wanted, weight = np.zeros(count), np.zeros(count)
    wanted[seen.rows], weight[seen.rows] = _wanted(seen), (seen.gain / sigma) ** 2
    states = _States.of(seen.view, interval / PARTS)
    delay = round(seen.view.delay_s / interval * PARTS)
    return states.followed(wanted, weight, data.held.at(data.t[:count]), delay) / PARTS


def _wanted(seen: Seen) -> FloatArray:
    """Return the response of the process at the samples that leaves nothing."""
    result: FloatArray = seen.left / seen.gain + seen.view.forced(seen.view.input)[seen.rows]
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _States:
    """The process from one part of a sample to the next: `x M + v b`, whose response is `x c`."""

    M: FloatArray
    b: FloatArray
    c: FloatArray

    @classmethod
    def of(cls, view: View, part_s: float) -> _States:
        """Return it from the motions of any initial state, which are read a sample apart: closer, they look alike."""
        apart: FloatArray = PARTS * part_s * np.arange(len(view.motion.free(np.zeros(1))), dtype=np.float64)
        at_once, later = (np.array(view.motion.free(apart + by)).T for by in (0.0, part_s))
        pulse = HeldInput(np.array([0.0, 0.0, part_s]), np.array([0.0, 1.0, 0.0]))
        after = view.motion.forced(pulse, apart + part_s)[0][0]
        M, b = (np.asarray(np.linalg.solve(at_once, of), np.float64) for of in (later, after))
        return cls(M.T, b, at_once[0])

    def followed(self, wanted: FloatArray, weight: FloatArray, output: FloatArray, delay: int) -> FloatArray:
        """Return at which parts of samples the cheapest sequence takes the output over; the delay is in such parts."""
        states, position, cost = np.zeros((1, self.c.size)), np.zeros(1), np.zeros(1)
        steps: list[tuple[IntArray, IntArray]] = []
        of_update = 2.0 * math.log(wanted.size)
        for k in range(wanted.size - 1):
            parts = k * PARTS + np.arange(PARTS) - delay
            levels = output[np.maximum(parts, 0) // PARTS]
            branches = [self._over_a_sample(states, position)]
            begun = np.flatnonzero(parts >= 0).tolist()
            branches += [self._over_a_sample(states, position, j, levels[j]) for j in begun]
            states, position = (np.concatenate(of) for of in zip(*branches, strict=True))
            taken = np.repeat([-1, *begun], cost.size)
            parents = np.tile(np.arange(cost.size), len(branches))
            cost = cost[parents] + of_update * (taken >= 0) + weight[k + 1] * (wanted[k + 1] - states @ self.c) ** 2
            kept = np.argpartition(cost, CARRIED)[:CARRIED] if cost.size > CARRIED else np.arange(cost.size)
            states, position, cost = states[kept], position[kept], cost[kept]
            steps.append((parents[kept], taken[kept]))
        return _back(steps, int(np.argmin(cost)), delay)

    def _over_a_sample(
        self, states: FloatArray, position: FloatArray, taken: int = -1, level: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return states and positions a sample later, the level taken over at one of its parts, or not."""
        for j in range(PARTS):
            if j == taken:
                position = np.full(position.size, level)
            states = states @ self.M + position[:, None] * self.b
        return states, position


def _back(steps: Sequence[tuple[IntArray, IntArray]], at: int, delay: int) -> FloatArray:
    """Return the updates of a sequence from its end, in parts of samples."""
    updates = []
    for k in range(len(steps) - 1, -1, -1):
        parents, taken = steps[k]
        if taken[at] >= 0:
            updates.append(float(k * PARTS + taken[at] - delay))
        at = parents[at]
    return np.array(updates[::-1])


def beside(seen: Seen, updates: FloatArray, *, searched: bool) -> Effect:
    """Return an actuator that took its output over at times which the samples show."""
    t = seen.view.dataset.data.t
    seen_until_s = max(float(t[seen.rows[-1]]) - seen.view.delay_s, float(t[0]))
    return updated_at(seen.view.dataset, updates, seen_until_s, searched=searched)


def _in_detail(seen: Seen, effect: Effect) -> Effect:
    """Return updates with the times between the parts of a sample that are closest, beside a process as it is."""
    assert effect.position is not None  # noqa: S101 - it has them
    assert effect.slopes is not None  # noqa: S101
    dataset, view = seen.view.dataset, replace(seen.view, t=seen.view.t[seen.rows])
    low, high = (np.array([getattr(s, end) for s in effect.searched]) for end in ("low", "high"))
    p, wanted = np.array(effect.starts[0]), _wanted(seen)
    tried: list[tuple[float, tuple[float, ...]]] = []
    for _ in range(MOST_STEPS):
        left = wanted - view.forced(effect.position(dataset.data.held, p.tolist(), dataset))
        tried.append((float(left @ left), tuple(p.tolist())))
        move = np.linalg.lstsq(effect.slopes(view, p.tolist()), left, rcond=UNSEEN)[0]
        p = np.clip(p + move, low, high)
    return replace(effect, starts=[min(tried)[1]])


def updated_at(dataset: Dataset, updates: FloatArray, seen_until_s: float, *, searched: bool) -> Effect:
    """Return an actuator that takes its output over at some times, and later on as late as it was in the mean.

    Parameters
    ----------
    dataset : Dataset
        The record of a loop.
    updates : array of float
        Times, in samples, the earliest first.
    seen_until_s : float
        Time until which there is no further one, s.
    searched : bool
        Whether the times are searched for, each within its sample.
    """
    start_s, interval, samples = dataset.data.t[0], dataset.data.interval_s, np.floor(updates)
    middles_s = start_s + interval * (samples + 0.5)
    late = _Lateness.of(dataset.data.held, middles_s)
    period_s = 2.0 * UNIFORM * late.spread_s

    def times_s(p: Sequence[float]) -> FloatArray:
        times: FloatArray = start_s + interval * (np.array(p) if searched else updates)
        return times

    def position(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        own = times_s(p)
        later = held.times > own[-1]
        times = np.concatenate(
            (held.times[:1], own, np.maximum(held.times[later] + late.mean_s, max(own[-1], seen_until_s)))
        )
        levels = np.concatenate((held.levels[:1], held.at(middles_s), held.levels[later]))
        return HeldInput(times, levels)

    def slopes(view: View, p: Sequence[float]) -> FloatArray:
        steps = position(dataset.data.held, p, dataset).steps[1 : len(p) + 1]
        return view.slopes_with_times(times_s(p), interval * steps)

    def seen_again(seen: Seen) -> Effect | None:
        again = updates_in_loop(seen, max(noise_sigma(seen.left), SMALLEST_DIVISOR)) if seen.alone else np.zeros(0)
        return _in_detail(seen, beside(seen, again, searched=True)) if again.size else None

    return Effect(
        "actuator_hold",
        Place.ACTUATOR,
        tuple(Searched(f"update_{k}", s, s + 1.0 - WITHIN) for k, s in enumerate(samples)) if searched else (),
        [tuple(updates.tolist())] if searched else [()],
        lambda _p, _c, _g: {"period_s": period_s},
        form="uneven",
        position=position,
        slopes=slopes if searched else None,
        group="timing",
        unseen_after=True,
        lateness_s=lambda _p: late.spread_s,
        seen_again=seen_again if searched else None,
        blur=lambda _p: {"period_s": NORMAL_95 * OF_A_SPREAD / math.sqrt(late.count) * period_s},
    )


@dataclass(frozen=True, slots=True)
class _Lateness:
    """How late the moves of an output arrive, weighted by their sizes; and how many that would be alike."""

    mean_s: float
    spread_s: float
    count: float

    @classmethod
    def of(cls, held: HeldInput, updates_s: FloatArray) -> _Lateness:
        """Return it for the moves until the last update."""
        moments, sizes = held.times[1:], np.abs(held.steps[1:])
        seen = moments <= updates_s[-1]
        turn = np.searchsorted(updates_s, moments[seen])
        late, total = updates_s[turn] - moments[seen], max(float(sizes[seen].sum()), SMALLEST_DIVISOR)
        weights = sizes[seen] / total
        mean = float(weights @ late)
        of_each = np.bincount(turn, weights)
        return cls(
            mean, math.sqrt(float(weights @ (late - mean) ** 2)), 1.0 / max(float(of_each @ of_each), SMALLEST_DIVISOR)
        )
