"""Exact motion of three or more lags in a row while their input is constant.

    T_i x_i' = x_{i-1} - x_i,   x_0 = u,   y = K x_n

by the exponential of `[[A, B], [0, 0]] h`, which carries the input along as one more state (Van Loan, IEEE Transactions
on Automatic Control 23, 1978). Lags `T_i` in s, equal or not; `u` and `y` as deviations from rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner_sim.plants.crossing import find_root
from autotuner_sim.plants.motion import SETTLED

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from autotuner_sim.plants.motion import State


@lru_cache(maxsize=256)
def _chain_matrix(lags: tuple[float, ...]) -> NDArray[np.float64]:
    """Return `[[A, B], [0, 0]]` of lags in a row; the last column is the input."""
    order = len(lags)
    matrix = np.zeros((order + 1, order + 1))
    for i, lag in enumerate(lags):
        matrix[i, i] = -1.0 / lag
        matrix[i, i - 1] = 1.0 / lag
    return matrix


@lru_cache(maxsize=1024)
def _chain_transition(lags: tuple[float, ...], h: float) -> NDArray[np.float64]:
    transition: NDArray[np.float64] = scipy.linalg.expm(_chain_matrix(lags) * h)
    return transition


@dataclass(frozen=True, slots=True)
class LagChainMotion:
    """Lags in a row, in any number and equal or not, and a gain after them."""

    lags: tuple[float, ...]
    gain: float

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""
        return (0.0,) * len(self.lags)

    @property
    def time_scale_s(self) -> float:
        """Sum of the lags, s."""
        return sum(self.lags)

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""
        return tuple((_chain_transition(self.lags, h) @ (*x, u))[:-1].tolist())

    def output(self, x: State) -> float:
        """Return the PV of a state."""
        return self.gain * x[-1]

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:
        """Yield the zeros of the slope of the last lag.

        `f_n = x_n'` is a sum of n exponentials. `f_{k-1} = f_k' - p_k f_k` lacks one of them, and by Rolle's theorem
        (on `e^{-p_k t} f_k`) the zeros of `f_k` lie one to each gap between zeros of `f_{k-1}`; `f_1` has none.
        """
        matrix = _chain_matrix(self.lags)
        slope = (matrix @ (*x, u))[:-1]
        end = min(span, SETTLED * max(self.lags))
        row = np.zeros(len(self.lags))
        row[-1] = 1.0
        return iter(self._zeros(row, len(self.lags), slope, end))

    def _zeros(self, row: NDArray[np.float64], level: int, slope: NDArray[np.float64], end: float) -> list[float]:
        if level == 1:
            return []
        matrix = _chain_matrix(self.lags)[:-1, :-1]
        without_one = row @ matrix + row / self.lags[level - 1]

        def value(s: float) -> float:
            return float(row @ (_chain_transition(self.lags, s)[:-1, :-1] @ slope))

        gaps = [0.0, *self._zeros(without_one, level - 1, slope, end), end]
        return [find_root(value, low, high) for low, high in pairwise(gaps) if _opposite(value(low), value(high))]


def _opposite(one: float, other: float) -> bool:
    return one < 0.0 < other or other < 0.0 < one
