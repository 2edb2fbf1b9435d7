"""The learned correction: what trained networks add to the model that the harmonics give, and how wrong that may be.

    s     = exp(spread(x) + c)                 what the start is usually wrong by
    v     = v_start + s mean(x)                coordinates without unit, see `harmonic_start`
    se    = s exp(rest(x)) q68,   95 % within  se q95
    net   = W2 relu(W1 relu(W0 x + b0) + b1) + b2

`x` features of `learned_features`; `c = 0.635` turns the mean of a normal error's logarithm into that of its size;
`q68`, `q95` are quantiles on experiments that were not trained on. Networks are plain arrays, three side by side.

Rules of this file: no file and no training library here; a wave outside of what was trained on is refused, not
extrapolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.harmonic_start import start
from autotuner.core.identification.learned_features import features
from autotuner.core.identification.learned_model import intervals, model_of
from autotuner.core.identification.relay_wave import wave_of
from autotuner.core.identification.result import Estimate, refuse
from autotuner.core.signals.noise import noise_sigma

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification.relay_wave import RelayWaves
    from autotuner.core.recording import Recording

LEARNED = "learned"
LOG_NORMAL = 0.635
"""Minus the mean of `log |z|` of a standard normal `z`."""
CLASSES = ("fopdt", "sopdt_overdamped", "sopdt_underdamped", "integrating")
NOT_LOADED = "no trained correction is loaded"
SURE = 0.3
"""Relative standard error of a static gain up to which it is one."""


@dataclass(frozen=True, slots=True, eq=False)
class Networks:
    """Networks of one shape side by side: weights (M, in, out) and offsets (M, 1, out) of each layer."""

    weights: tuple[FloatArray, ...]
    offsets: tuple[FloatArray, ...]

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the outputs for rows (B, F), shape (M, B, P)."""
        for weight, offset in zip(self.weights[:-1], self.offsets[:-1], strict=True):
            x = np.maximum(x @ weight + offset, 0.0)
        last: FloatArray = x @ self.weights[-1] + self.offsets[-1]
        return last


@dataclass(frozen=True, slots=True, eq=False)
class Domain:
    """Where experiments were trained on: a box of features, and a distance from their mean in their own scatter."""

    low: FloatArray
    high: FloatArray
    mean: FloatArray
    whitening: FloatArray
    farthest: float

    def beyond(self, x: FloatArray) -> float:
        """Return how far outside a row is, 1 at the edge; the larger of box and distance."""
        half = (self.high - self.low) / 2.0
        box = float(np.max(np.abs(x - self.low - half) / half))
        away = (x - self.mean) @ self.whitening
        return max(box, math.sqrt(float(away @ away)) / self.farthest)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What was trained for one structure.

    Attributes
    ----------
    networks : Networks
        Spread of the start's error, mean of it in that spread, spread of the rest.
    q68, q95 : array of float, shape (P,)
        Quantiles of the error over its predicted standard error.
    domain : Domain
        Where it may be used.
    least, most : array of float, shape (P,)
        Range of the processes trained on, in the structure's coordinates.
    """

    networks: Networks
    q68: FloatArray
    q95: FloatArray
    domain: Domain
    least: FloatArray
    most: FloatArray

    def apply(self, x: FloatArray, begun: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return corrected coordinates and their standard errors, shape (B, P)."""
        spread, mean, rest = self.networks(x)
        size = np.exp(spread + LOG_NORMAL)
        return begun + size * mean, size * np.exp(rest) * self.q68

    def knows(self, values: FloatArray) -> bool:
        """Return whether a process is among those trained on, not only its wave among theirs."""
        return bool(np.all((self.least <= values) & (values <= self.most)))


@dataclass(frozen=True, slots=True, eq=False)
class LearnedModels:
    """All corrections by structure, and the networks that tell structures apart."""

    corrections: Mapping[str, Correction]
    classifier: Networks
    classifier_domain: Domain
    about: Mapping[str, object] = field(default_factory=dict)

    def probabilities(self, wave: RelayWaves) -> dict[str, float]:
        """Return how likely each structure is, from the shape of the wave alone; empty outside of the training."""
        x = shape_features(wave)
        if not self.classifier_domain.beyond(x[0]) <= 1.0:
            return {}
        score = self.classifier(x)[0, 0]
        share = np.exp(score - score.max())
        return dict(zip(CLASSES, (share / share.sum()).tolist(), strict=True))


def shape_features(wave: RelayWaves) -> FloatArray:
    """Return the features that need no static gain, shape (B, F)."""
    nothing = np.zeros(wave.Pu.size)
    return features(wave, nothing + 1.0, nothing, start("integrating", wave, nothing + 1.0))


def by_learned(
    recording: Recording,
    structure: str | None,
    gain: tuple[float, float] | None,
    models: LearnedModels | str | None,
    sign: float = 1.0,
    fallback: tuple[float, float] | None = None,
) -> Estimate:
    """Return the learned estimate of a relay record, complete or still running.

    Parameters
    ----------
    recording : Recording
        The samples so far.
    structure : str or None
        Structure wanted; the likeliest when None.
    gain : (float, float) or None
        Static gain and its standard error, PV/output; that of the relay's asymmetry when None.
    models : LearnedModels, str or None
        What was trained, or why there is none.
    sign : float
        A number of the sign of the process's gain, where none is given.
    fallback : (float, float) or None
        As `gain`, for a relay without asymmetry.
    """
    if not isinstance(models, LearnedModels):
        return refuse(LEARNED, models or NOT_LOADED)
    sign = math.copysign(1.0, sign if gain is None else gain[0])
    wave = wave_of(recording, _sigma(recording), sign)
    if wave is None:
        return refuse(LEARNED, "the recording holds no oscillation under a relay")
    likely = models.probabilities(wave)
    evidence: dict[str, object] = {
        "structure_probability": likely,
        "cycles": float(wave.cycles[0]),
        "Pu": float(wave.Pu[0]),
    }
    structure = structure or (max(likely, key=lambda name: likely[name]) if likely else None)
    if structure is None or structure not in models.corrections:
        return refuse(LEARNED, f"nothing was trained for {structure or 'a wave of this shape'}", evidence)
    known = (1.0, 0.0) if structure == "integrating" else _gain_of(wave, gain, fallback)
    if known is None:
        return refuse(LEARNED, "the static gain is not known: give it, or use an asymmetric relay", evidence)
    return _corrected(wave, structure, known, models.corrections[structure], sign, evidence)


def _corrected(
    wave: RelayWaves,
    structure: str,
    known: tuple[float, float],
    correction: Correction,
    sign: float,
    evidence: dict[str, object],
) -> Estimate:
    r, error = np.array([known[0]]), np.array([known[1]])
    begun = start(structure, wave, r)
    if not bool(begun.exists[0]):
        return refuse(LEARNED, f"no process of the structure {structure} oscillates so with this static gain", evidence)
    x = features(wave, r, error, begun)
    beyond = correction.domain.beyond(x[0])
    evidence |= {"start": begun.values[0].tolist(), "of_domain": beyond}
    if not beyond <= 1.0:
        return refuse(LEARNED, f"outside of what it was trained on: {beyond:.2g} times as far as its edge", evidence)
    values, errors = correction.apply(x, begun.values)
    if not correction.knows(values[0]):
        return refuse(LEARNED, "the process lies outside of those that it was trained on", evidence)
    model = model_of(structure, values[0], wave, sign)
    if model is None:
        return refuse(LEARNED, f"the correction leaves no process of the structure {structure}", evidence)
    standard = intervals(structure, values[0], errors[0], model)
    wide = intervals(structure, values[0], errors[0] * correction.q95, model)
    return Estimate(
        LEARNED,
        model,
        standard,
        {name: (value - wide[name], value + wide[name]) for name, value in model.parameters().items()},
        evidence=evidence,
    )


def _gain_of(
    wave: RelayWaves, gain: tuple[float, float] | None, fallback: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return the gain times `U1/A1` and its relative error, or None where none is known."""
    shown, error = float(wave.gain[0]), float(wave.gain_error[0])
    if gain is None and shown > 0.0 and error < SURE * shown:
        return shown, error / shown
    known = gain or fallback
    if known is None:
        return None
    return abs(known[0]) * float(wave.U1[0] / wave.A1[0]), known[1] / abs(known[0])


def _sigma(recording: Recording) -> float:
    measured = recording.settings.get("noise_sigma")
    return measured if isinstance(measured, float) and measured >= 0.0 else noise_sigma(recording.pv)
