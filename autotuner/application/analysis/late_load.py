"""A load that came when the model was already being judged: it says nothing against the model.

    pv(t) - simulated(t) = c s(t - t_c) + noise        on the part of the record that was not fitted

`s` is the answer of the identified process to a unit step at its input, `c` the size of the load, output units, and
`t_c` the moment at which it came, s.

Rules of this file: the load explains the misfit to the noise, and comes after the PV has followed at least half of
what the output does there, with no more than noise between PV and model. A wrong gain would show until then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.simulation import response
from autotuner.core.identification.held_out import HeldOut, residual_beyond
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

MOMENTS = 150
"""Moments at which a load is tried."""
FOLLOWED = 0.5
"""Share of the PV's motion on the part not fitted that the model has to explain before the load."""
FEWEST = 10
"""Samples before the load, and after it, at least."""


@dataclass(frozen=True, slots=True)
class LateLoad:
    """A load on the part of a record that was not fitted.

    Attributes
    ----------
    at_s : float
        When it came, s.
    size : float
        Its size, output units.
    error : HeldOut
        What the model misses beside it.
    """

    at_s: float
    size: float
    error: HeldOut

    @property
    def words(self) -> str:
        """What to say about it."""
        return (
            f"a load of {self.size:.3g} of output came at {self.at_s:.4g} s, after the part of the record that the "
            "model is fitted to: until then, and beside it, the model misses no more than noise"
        )


def late_load(model: ProcessModel, recording: Recording, fitted_until_s: float, noise_sigma: float) -> LateLoad | None:
    """Return the load that explains what a model misses on the part that was not fitted; None where none does.

    Parameters
    ----------
    model : ProcessModel
        Fitted to the samples up to `fitted_until_s`.
    recording : Recording
        The whole record, starting at rest.
    fitted_until_s : float
        Where the part not fitted begins, s.
    noise_sigma : float
        Standard deviation of what moves the PV at rest, PV units.
    """
    left, judged = residual_beyond(model, recording, fitted_until_s), recording.t > fitted_until_s
    first = _first_moment(model, recording, judged)
    if first is None:
        return None
    t, missed = recording.t[judged], left[judged]
    tried = np.unique(np.linspace(first, t.size - 1 - FEWEST, MOMENTS).astype(int))
    answers = [_answer(model, t, float(t[k])) for k in tried]
    sizes = [float(answer @ missed) / max(float(answer @ answer), np.finfo(float).tiny) for answer in answers]
    errors = [rms(missed - size * answer) for size, answer in zip(sizes, answers, strict=True)]
    best = int(np.argmin(errors))
    motion = float(recording.pv.std())
    error = HeldOut(rms(left[~judged]), errors[best], noise_sigma, motion)
    before = HeldOut(error.fitted, rms(missed[: tried[best]]), noise_sigma, motion)
    if error.warning is not None or before.warning is not None:
        return None
    return LateLoad(float(t[tried[best]]), sizes[best], error)


def _first_moment(model: ProcessModel, recording: Recording, judged: BoolArray) -> int | None:
    """Return the first judged sample at which the PV has followed enough to distinguish a load from a wrong gain."""
    moved = response(model, recording.acts_s, recording.output - recording.output[0], recording.t)[judged]
    if moved.size < 2 * FEWEST + 1:
        return None
    so_far = np.maximum.accumulate(moved) - np.minimum.accumulate(moved)
    first = max(int(np.argmax(so_far >= FOLLOWED * so_far[-1])), FEWEST)
    return None if so_far[-1] <= 0.0 or first > moved.size - 1 - FEWEST else first


def _answer(model: ProcessModel, t: FloatArray, at_s: float) -> FloatArray:
    """Return the answer to a unit step at the input of the process, which no dead time delays."""
    return response(replace(model, D=0.0), t, np.where(t >= at_s, 1.0, 0.0))  # type: ignore[type-var]
