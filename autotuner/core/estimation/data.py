"""Samples in the form for least squares: time from the start, PV about its median, the output as its changes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.noise.ar_noise import Coloured
from autotuner.core.estimation.noise.timing_jitter_model import TimingJitterModel
from autotuner.core.model.zoh_input import HeldInput, held_input

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording


class TimeSpentError(Exception):
    """The time limit of a search has passed; its caller catches this exception."""


@dataclass(frozen=True, slots=True, eq=False)
class Data:
    """One recording.

    Attributes
    ----------
    t, pv : array of float, shape (N,)
        Seconds since the first sample; PV as deviation from its median.
    held : HeldInput
        The output.
    weight : array of float, shape (N,)
        Weight of each sample's residual: 1, or 0 for a sample that does not count.
    shaken : TimingJitterModel or None
        What unsure moments of the output's changes add to the noise; None when they are taken as they stand.
    others : tuple of HeldInput
        Measured disturbances, which move the PV besides the output.
    coloured : Coloured or None
        What the noise remembers from sample to sample; None when it is taken as white.
    is_spent : callable or None
        Returns whether the time for the search is spent: `core` reads no clock. None without a limit.
    """

    t: FloatArray
    pv: FloatArray
    held: HeldInput
    weight: FloatArray
    shaken: TimingJitterModel | None = None
    others: tuple[HeldInput, ...] = ()
    coloured: Coloured | None = None
    is_spent: Callable[[], bool] | None = None

    def require_time(self) -> None:
        """Return while there is time; called before each evaluation of a model.

        Raises
        ------
        TimeSpentError
            The time is spent.
        """
        if self.is_spent is not None and self.is_spent():
            raise TimeSpentError

    @property
    def span_s(self) -> float:
        """Length of the recording, s."""
        return float(self.t[-1])

    @property
    def interval_s(self) -> float:
        """Mean sample interval, s."""
        return self.span_s / (self.t.size - 1)

    def thinned(self, most: int) -> Data:
        """Return every k-th sample, `most` of them at most; the output keeps all its changes."""
        step = max(1, math.ceil(self.t.size / most))
        weight = self.weight[::step]
        shaken = (
            None
            if self.shaken is None
            else TimingJitterModel.of(self.shaken.columns[::step], weight, self.shaken.sigma)
        )
        return Data(self.t[::step], self.pv[::step], self.held, weight, shaken, self.others, is_spent=self.is_spent)

    def weighted(self, weight: FloatArray) -> Data:
        """Return the same samples with other weights."""
        shaken = None if self.shaken is None else TimingJitterModel.of(self.shaken.columns, weight, self.shaken.sigma)
        coloured = None if self.coloured is None else Coloured.of(self.coloured.memory, self.t, weight)
        return replace(self, weight=weight, shaken=shaken, coloured=coloured)

    def balanced(self, values: FloatArray) -> FloatArray:
        """Return columns of samples, or a single one, as they enter a sum of squares: weighted, their noise white."""
        result: FloatArray = values * (self.weight if values.ndim == 1 else self.weight[:, None])
        return self.whitened(result)

    def whitened(self, values: FloatArray) -> FloatArray:
        """Return weighted columns of samples, or a single one, after the filter that makes their noise white."""
        for noise in (self.shaken, self.coloured):
            values = values if noise is None else noise.whitened(values)
        return values


@dataclass(frozen=True, slots=True)
class GainPrior:
    """Prior knowledge of the static gain.

    Attributes
    ----------
    known : float or None
        Its value, PV/output.
    sign : int
        Its sign; 0 when unknown.
    """

    known: float | None = None
    sign: int = 0

    def allows(self, gain: float) -> bool:
        """Return whether a gain has the right sign."""
        return gain * self.sign >= 0.0


ANY_GAIN = GainPrior()


def data_of(recording: Recording, disturbances: Sequence[str] = ()) -> Data:
    """Return the samples of a recording; `disturbances` are names of its extra columns that move the PV too.

    The times of its output's changes are exact where the record has the times of writing, or where it is known to
    be of an experiment, whose outputs are written at the samples.
    """
    t = recording.t - recording.t[0]
    held = held_input(recording.acts_s - recording.t[0], recording.output)
    if recording.written_s is not None or recording.settings:
        held = replace(held, slack_s=None)
    others = tuple(replace(held_input(t, recording.extra[name]), slack_s=None) for name in disturbances)
    return Data(t, recording.pv - np.median(recording.pv), held, np.ones_like(t), others=others)
