"""Bands of a sticking valve in a loop, by the answers of the process to all positions that they leave.

    S = s/(1 + f),   F = f S        s travel of the command between two slips of opposite direction, f = 1 is play
    y = K (h * x) + dT (h_T * x) + dD (h_D * x) + background,   least squares

`x` position of the valve (see `effects.actuator.friction`), `h` answer of the process to a pulse of one sample, `h_T`
and `h_D` its slopes with lag and dead time. When a valve slips depends on its bands in jumps, so that no slope leads to
the right ones. A whole grid is computed at once: the positions by one pass over the output, the answers by Fourier
transforms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.extended.extended_model import Extended
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import ComplexArray, FloatArray, IntArray
    from autotuner.core.model.structures import Structure

MOST_SAMPLES = 2000
"""Most samples of the even grid: the positions are a matrix of that many columns."""
STEP = 1e-3
"""Change of a logarithm of a lag, and of a dead time in units of the problem, for slopes."""
AT_ONCE = 100
"""Positions whose answers are in memory at once: some 10 MB."""
RIDGE = 1e-9
"""Regularisation of the normal equations for dependent columns."""


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of a valve, and its positions with each of them.

    Attributes
    ----------
    dataset : Dataset
        The recording.
    bands, left : array of float, shape (M,)
        `S`, in swings of the output, and `F` over it.
    rows : array of int, shape (R,)
        Samples that are compared.
    background : tuple of str
        What the PV does besides.
    beside : tuple of Effect
        Loads beside the valve, all of whose numbers are sizes.
    """

    dataset: Dataset
    bands: FloatArray
    left: FloatArray
    rows: IntArray
    background: tuple[str, ...]
    beside: tuple[Effect, ...] = ()

    def squares(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """Return the squares that are left with each position if the process may move along its tangent, shape (M,)."""
        pulses = self._pulses(structure, theta)
        alone = Extended(self.dataset, structure, self.beside, self.rows, self.background)
        basis = scipy.linalg.orth(alone.columns(theta, self.rows)[0][:, structure.gains :])
        pv = self.dataset.data.pv[self.rows]
        target = pv - basis @ (basis.T @ pv)
        parts = range(0, self.bands.size, AT_ONCE)
        falls = [self._fall(pulses, self._spectra[k : k + AT_ONCE], basis, target) for k in parts]
        result: FloatArray = float(target @ target) - np.concatenate(falls)
        return result

    def _fall(self, pulses: ComplexArray, spectra: ComplexArray, basis: FloatArray, target: FloatArray) -> FloatArray:
        """Return by how much the answers to some positions lessen the squares of the target, shape (m,)."""
        answers = np.fft.irfft(spectra[:, None] * pulses, self._size)[..., self._at]
        own = answers - (answers @ basis) @ basis.T
        gram = own @ own.transpose(0, 2, 1)
        size = np.maximum(np.sqrt(np.einsum("mii->mi", gram)), SMALLEST_DIVISOR)
        gram = gram / size[:, :, None] / size[:, None, :] + RIDGE * np.eye(gram.shape[1])
        moment = own @ target / size
        fall: FloatArray = np.einsum("mi,mi->m", moment, np.linalg.solve(gram, moment[..., None])[..., 0])
        return fall

    def _pulses(self, structure: Structure, theta: FloatArray) -> ComplexArray:
        """Return the spectra of the answer to a pulse and of its slopes, shape (1 + count, F)."""
        problem = Extended(self.dataset, structure, (), self.rows, self.background)
        grid = replace(self.dataset, data=replace(self.dataset.data, t=self._t))
        on_grid = replace(problem, dataset=grid)
        pulse = HeldInput(np.array([0.0, self._t[1]]), np.array([1.0, 0.0]))
        everywhere = np.arange(self._t.size)
        at, *moved = (
            on_grid.view(theta + STEP * direction, everywhere).forced(pulse)
            for direction in (np.zeros(theta.size), *np.eye(theta.size))
        )
        spectra: ComplexArray = np.fft.rfft(np.stack((at, *((m - at) / STEP for m in moved))), self._size)
        return spectra

    @cached_property
    def _t(self) -> FloatArray:
        """Times of the even grid, s from the start."""
        until = float(self.dataset.data.t[self.rows[-1]])
        count = min(round(until / self.dataset.data.interval_s) + 1, MOST_SAMPLES)
        return np.linspace(0.0, until, count)

    @cached_property
    def _at(self) -> IntArray:
        """Where the samples are on the even grid."""
        at: IntArray = np.round(self.dataset.data.t[self.rows] / self._t[1]).astype(np.intp)
        return at

    @cached_property
    def _size(self) -> int:
        size: int = scipy.fft.next_fast_len(2 * self._t.size, real=True)
        return size

    @cached_property
    def _spectra(self) -> ComplexArray:
        levels = self.dataset.data.held.at(self._t) / self.dataset.swing
        spectra: ComplexArray = np.fft.rfft(positions(levels, self.bands, self.left * self.bands), self._size)
        return spectra


def bands_of(travels: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return all pairs of `S` and `F/S` for travels between two slips, in swings, and `F/S`."""
    s, f = (grid.ravel() for grid in np.meshgrid(travels, left, indexing="ij"))
    return s / (1.0 + f), f


def positions(levels: FloatArray, bands: FloatArray, left: FloatArray) -> FloatArray:
    """Return the positions of valves with `bands` that come to rest `left` short of the command, shape (M, N)."""
    x, result = np.zeros(bands.size), np.empty((levels.size, bands.size))
    for k, level in enumerate(levels.tolist()):
        off = level - x
        x = np.where(np.abs(off) > bands, level - np.sign(off) * left, x)
        result[k] = x
    return result.T
