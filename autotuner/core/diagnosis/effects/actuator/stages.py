"""An actuator with stages of unequal size: each threshold that the output passes moves it by one of them.

    v = sum_j h_j [u > theta_j],   h_j > 0
    theta_j = a + b (h_1 + .. + h_{j-1} + h_j/2)

`v` position, `u` output, `theta_j` thresholds, `h_j` heights. A stage begins where the output is nearer to it than to
the one before, in the middle of the step between: the second line, fitted with weights `h_j`, gives heights in units of
the output, and with them the gain of the process, also where one stage was found as two. The position has the heights
that were found before. Columns correct them, and leave their sum as it is. Beyond the outputs of the fitted part, the
stages are taken to go on, each of the mean height. (Starts: `position_in_loop`.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, between
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

GOLDEN = 0.6180339887
"""Golden section: places of several thresholds between their outputs are spread evenly by it."""
FEWEST = 2
"""Thresholds that show how high a stage is, in units of the output."""


def unequal_stages(dataset: Dataset, thresholds: FloatArray, heights: FloatArray) -> Effect:
    """Return an actuator with stages.

    Parameters
    ----------
    dataset : Dataset
        The recording.
    thresholds : array of float, shape (J,)
        Outputs at which the stages begin, as deviations from the first output, in swings, the lowest first.
    heights : array of float, shape (J,)
        Height of each stage, in any unit.
    """
    swing = dataset.swing
    known = swing * _height_in_outputs(thresholds, heights) * heights

    further = _further(dataset, swing * thresholds, float(known.mean()))

    def position(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        v = known @ (held.levels > swing * np.array(p)[:, None]) + further(held.levels)
        return HeldInput(held.times, v - v[0]).without_repeats()

    def in_all(c: Sequence[float], gain: float) -> FloatArray:
        result: FloatArray = known + np.diff(c, prepend=0.0, append=0.0) / gain
        return result

    return Effect(
        "output_quantisation",
        Place.ACTUATOR,
        tuple(Searched(f"threshold_{k}", -np.inf, np.inf, 0.0) for k in range(1, thresholds.size + 1)),
        [tuple(thresholds.tolist())],
        lambda _p, c, g: {"step": float(in_all(c, g).max())},
        form="unequal",
        position=position,
        columns=lambda view, p: _moved_to_the_next(view, swing * np.array(p)),
        order=4,
        group="curve",
        means=lambda _p, c, g, _shape: bool(in_all(c, g).min() > 0.0),
        alike=lambda p, until_s: _alike(dataset, np.array(p), until_s),
    )


def _alike(dataset: Dataset, thresholds: FloatArray, until_s: float) -> list[tuple[float, ...]]:
    """Return thresholds, in swings, that every output until a time passes as it does those: all are moved at once."""
    held = dataset.data.held
    low, high = outputs_around(held.levels[held.times < until_s] / dataset.swing, thresholds)
    shares = (between(0.0, 1.0)[:, None] + GOLDEN * np.arange(thresholds.size)) % 1.0
    return [tuple(t.tolist()) for t in low + (high - low) * shares]


def outputs_around(outputs: FloatArray, thresholds: FloatArray) -> FloatArray:
    """Return the next output below and above each threshold, shape (2, J): all between them are alike."""
    known = np.unique(outputs)
    after = np.clip(np.searchsorted(known, thresholds, side="right"), 1, known.size - 1)
    return np.stack((known[after - 1], known[after]))


def _height_in_outputs(thresholds: FloatArray, heights: FloatArray) -> float:
    """Return the unit of the heights, in that of the thresholds."""
    middles = np.cumsum(heights) - heights / 2.0
    off = middles - np.average(middles, weights=heights)
    return float((heights * off) @ thresholds / ((heights * off) @ off))


def _further(dataset: Dataset, thresholds: FloatArray, height: float) -> Callable[[FloatArray], FloatArray]:
    """Return the position by stages beyond the outputs of the fitted part, from the output, both in output units."""
    held = dataset.data.held
    known = held.levels[held.times < dataset.fitted_until_s]
    above, below = max(thresholds[-1] + height, known.max()), min(thresholds[0] - height, known.min())

    def position(u: FloatArray) -> FloatArray:
        up, down = np.floor((u - above) / height) + 1.0, np.floor((below - u) / height) + 1.0
        result: FloatArray = height * (np.maximum(up, 0.0) - np.maximum(down, 0.0))
        return result

    return position


def _moved_to_the_next(view: View, thresholds: FloatArray) -> list[FloatArray]:
    """Return what a unit of height at each threshold but the last brings that the next one loses."""
    held = view.dataset.data.held
    steps = HeldInput(held.times, passed(held.levels, thresholds)).without_repeats()
    return list(view.forced(HeldInput(steps.times, steps.levels[:-1] - steps.levels[1:])))


def passed(outputs: FloatArray, thresholds: FloatArray) -> FloatArray:
    """Return for each threshold, shape (J, N), 1 where an output is above it, as deviation from the first output."""
    above = (outputs > thresholds[:, None]).astype(float)
    levels: FloatArray = above - above[:, :1]
    return levels
