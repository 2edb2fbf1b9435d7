"""Autoregressive noise (coloured): each sample is predicted from the samples before it, the remainder is white.

    e_k = a_1 e_{k-1} + ... + a_p e_{k-p} + w_k,   w white,      whitened: w_k = e_k - a_1 e_{k-1} - ... - a_p e_{k-p}

`e` noise, PV, at samples in even steps. The first samples of a run have fewer predecessors: the best predictor of each
order `j < p`, with the remaining variance `s_j^2`, serves them, and `w` is weighted there by `s_p/s_j`. Least squares
after this whitening is maximum likelihood for such noise, also where feedback from the noisy PV moved the output,
where plain least squares is biased. (Ljung, System Identification, 1999, ch. 7.3 and 13.4; Burg, Maximum Entropy
Spectral Analysis, 1975; the order by Schwarz's criterion.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.model.arrays import FloatArray

LONGEST = 12
"""Highest order that is tried."""
SAMPLES_EACH = 20
"""Samples that a coefficient needs."""
LEAST_FORGOTTEN = 1e-6
"""Share of a constant offset that an innovation keeps at least; of a random walk it keeps none."""
UNEVEN = 0.1
"""Deviation from the usual step, as a share of it, from which on a run of samples ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Autoregressive model of the noise.

    Attributes
    ----------
    predictors : tuple of array of float
        That of order 0, 1, .. p: `(a_1, .. a_j)`, the latest sample first.
    left : tuple of float
        Standard deviation that each leaves, as a share of that of order 0.
    """

    predictors: tuple[FloatArray, ...]
    left: tuple[float, ...]

    @property
    def order(self) -> int:
        """`p`."""
        return len(self.predictors) - 1

    @property
    def samples_each(self) -> float:
        """Number of samples per independent sample, for the distinction of a slow response from the noise."""
        # A random walk forgets nothing; the least share keeps the number finite.
        forgets = max(abs(1.0 - float(self.predictors[-1].sum())), LEAST_FORGOTTEN)
        return (self.left[-1] / forgets) ** 2

    @property
    def swings_on(self) -> float:
        """Remaining share of its slowest oscillation after a period; 0 without an oscillation."""
        poles = np.roots(np.concatenate(([1.0], -self.predictors[-1])))
        swinging = poles[poles.imag > 0.0]
        return float(np.max(np.abs(swinging) ** (2.0 * math.pi / np.angle(swinging)), initial=0.0))

    def up_to(self, order: int) -> Memory:
        """Return the same with fewer coefficients."""
        return Memory(self.predictors[: order + 1], self.left[: order + 1])


@dataclass(frozen=True, slots=True, eq=False)
class Coloured:
    """The operator for the samples of one recording that count."""

    memory: Memory
    runs: tuple[slice, ...]

    @classmethod
    def of(cls, memory: Memory, t: FloatArray, weight: FloatArray) -> Coloured:
        """Make it of the memory, and of times and weights of the samples."""
        return cls(memory, even_runs(t, weight))

    def whitened(self, values: FloatArray) -> FloatArray:
        """Return columns of samples, or a single one, after the operator."""
        result: FloatArray = np.array(values)
        last = np.concatenate(([1.0], -self.memory.predictors[-1]))
        for run in self.runs:
            result[run] = np.apply_along_axis(np.convolve, 0, values[run], last)[: run.stop - run.start]
            for j, predictor in enumerate(self.memory.predictors[: run.stop - run.start]):
                k = run.start + j
                predicted = predictor @ values[run.start : k][::-1]
                result[k] = (values[k] - predicted) * (self.memory.left[-1] / self.memory.left[j])
        return result

    def past(self, noise: FloatArray) -> FloatArray:
        """Return the `p` samples before each, 0 before a run, shape (N, p): minus the slopes of `w` with `a`."""
        order, starts = self.memory.order, np.zeros(noise.size, dtype=np.intp)
        for run in self.runs:
            starts[run] = run.start
        back = np.arange(noise.size)[:, None] - np.arange(1, order + 1)
        return np.where(back >= starts[:, None], noise[np.maximum(back, 0)], 0.0)


def even_runs(t: FloatArray, weight: FloatArray) -> tuple[slice, ...]:
    """Return the runs of samples that count, in even steps."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    follows = (np.abs(steps - usual) < UNEVEN * usual) & (weight[1:] > 0.0) & (weight[:-1] > 0.0)
    ends = np.flatnonzero(~follows) + 1
    starts = np.concatenate(([0], ends))
    stops = np.concatenate((ends, [t.size]))
    return tuple(slice(int(a), int(b)) for a, b in zip(starts, stops, strict=True) if weight[a] > 0.0)


def memory_of(residual: FloatArray, fitted: FloatArray, runs: Sequence[slice]) -> Memory:
    """Return the memory of the noise that a residual is, by Burg's method; of order 0 where it is white."""
    parts = [column[run] for column in (residual, *fitted.T) for run in runs]
    samples = sum(run.stop - run.start for run in runs)
    whole = _burg(parts, min(LONGEST, samples // SAMPLES_EACH))
    prices = [2.0 * samples * math.log(max(left, 1e-12)) + j * math.log(samples) for j, left in enumerate(whole.left)]
    return whole.up_to(int(np.argmin(prices)))


def _burg(parts: list[FloatArray], order: int) -> Memory:
    """Return the predictors of all orders: each reflection coefficient is the best for both directions."""
    forward, backward = parts, parts
    predictors, left = [np.zeros(0)], [1.0]
    for j in range(order):
        forward_tails = [f[1:] for f in forward if f.size > 1]
        backward_heads = [b[:-1] for b in backward if b.size > 1]
        power = sum(float(f @ f + b @ b) for f, b in zip(forward_tails, backward_heads, strict=True))
        if power <= 0.0:
            break
        k = 2.0 * sum(float(f @ b) for f, b in zip(forward_tails, backward_heads, strict=True)) / power
        forward = [f - k * b for f, b in zip(forward_tails, backward_heads, strict=True)]
        backward = [b - k * f for f, b in zip(forward_tails, backward_heads, strict=True)]
        predictors.append(np.concatenate((predictors[j] - k * predictors[j][::-1], [k])))
        left.append(left[j] * math.sqrt(max(1.0 - k * k, 1e-12)))
    return Memory(tuple(predictors), tuple(left))
