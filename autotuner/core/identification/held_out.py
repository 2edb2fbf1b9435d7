"""Validation of a model on the held-out part of a record.

    e = pv - (offset + y),   y = response of the model to the whole output, offset = mean of pv - y over the fitted part
    rms = sqrt(mean e^2) over one part

Where the PV drifts at rest, or the process integrates a load, too, offset, drift and initial state are fitted to that
part and carried on beyond it.

An error on the part not fitted well above the noise means that the process has something in it that the model lacks.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.drift import drift_at_rest
from autotuner.core.estimation.simulation import response, simulate_fit
from autotuner.core.jsonable import jsonable
from autotuner.core.notes import SMALL_MISFIT, Doubt, Note
from autotuner.core.signals.noise import rms
from autotuner.core.signals.quiet import largest_wander

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

SUSPICIOUS = 1.5
"""Error over noise at which the misfit is visible to the eye and reported."""
AT_REST = 50
"""Samples before the relay from which the noise at rest is determined: what the experiment waits for at least."""
ABSURD = 1e4
"""Error over noise from which it has no number: an unstable model runs away on a part it was not fitted to."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Root mean square errors of a model, PV units.

    Attributes
    ----------
    fitted : float
        Over the part it was fitted to.
    held_out : float
        Over the part it was not fitted to.
    noise_sigma : float
        Standard deviation of the noise, as far as it moves the PV at rest.
    motion : float
        Standard deviation of the PV over the whole record; 0 where that is not known.
    """

    fitted: float
    held_out: float
    noise_sigma: float
    motion: float = 0.0

    @property
    def is_small(self) -> bool:
        """Whether the misfit of the model beyond noise is small compared with the motion of the PV."""
        missed = math.sqrt(max(self.held_out**2 - self.noise_sigma**2, 0.0))
        return missed <= SMALL_MISFIT * self.motion

    @property
    def is_small_throughout(self) -> bool:
        """Whether it is so on both parts, or no more than noise."""
        missed = math.sqrt(max(self.fitted**2 - self.noise_sigma**2, 0.0))
        fits = missed <= SMALL_MISFIT * self.motion or self.fitted <= SUSPICIOUS * self.noise_sigma
        return fits and (self.warning is None or self.is_small)

    @property
    def warning(self) -> Note | Doubt | None:
        """Message when the misfit on the held-out part exceeds noise; a note where it is small."""
        if self.noise_sigma <= 0.0 or self.held_out <= SUSPICIOUS * self.noise_sigma:
            return None
        times = self.held_out / self.noise_sigma
        shown = f"{self.held_out:.3g}, {times:.1f} times" if times < ABSURD else f"over {ABSURD:g} times"
        said = (
            f"on the part of the record that was not fitted the model misses by {shown} the noise: the process has "
            "something in it that the model lacks (dead-band, friction, saturation, a further lag, a disturbance)"
        )
        return Note(said) if self.is_small else Doubt(said)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {name: jsonable(value) for name, value in asdict(self).items()}


def held_out_error(model: ProcessModel, recording: Recording, fitted_until_s: float, noise_sigma: float) -> HeldOut:
    """Simulate the whole record and compare its two parts; parameters as in `residual_beyond`, `noise_sigma` PV units.

    `noise_sigma` is the standard deviation of what moves the PV at rest.
    """
    left = residual_beyond(model, recording, fitted_until_s)
    fitted = recording.t <= fitted_until_s
    return HeldOut(rms(left[fitted]), rms(left[~fitted]), noise_sigma, float(recording.pv.std()))


def wander_at_rest(recording: Recording) -> float:
    """Return the most that coloured noise moves the PV before the relay, PV units; 0 where it is white, or not known.

    The noise of neighbouring differences, which a fit states, leaves out how far such a PV wanders.
    """
    begins = recording.segments.get("relay")
    if begins is None:
        return 0.0
    before = np.flatnonzero((recording.t < begins) & (recording.output == recording.output[0]))[-AT_REST:]
    return largest_wander(recording.t[before], recording.pv[before])


def residual_beyond(model: ProcessModel, recording: Recording, fitted_until_s: float) -> FloatArray:
    """Return measured less simulated PV over the whole record, shape (N,), PV units, about its mean on the fitted part.

    Parameters
    ----------
    model : ProcessModel
        Fitted to the samples before `fitted_until_s`.
    recording : Recording
        The whole record, starting at rest.
    fitted_until_s : float
        Where the part not fitted begins, s.
    """
    moved = recording.output - recording.output[0]
    left = recording.pv - response(model, recording.acts_s, moved, recording.t)
    if model.rational().a[0] == 0.0 or drift_at_rest(data_of(recording)) is not None:
        left = recording.pv - simulate_fit(model, recording, fitted_until_s)
    about: FloatArray = left - left[recording.t <= fitted_until_s].mean()
    return about
