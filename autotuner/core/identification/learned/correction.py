"""Learned correction: trained networks correct the model from the harmonics, and estimate the error.

    s     = exp(spread(x) + c)                 usual error of the start
    v     = v_start + s mean(x)                coordinates without unit, see `harmonic_start`
    se    = s exp(rest(x)) q68,   95 % within  se q95
    net   = W2 relu(W1 relu(W0 x + b0) + b1) + b2

`x` features of `learned_features`; `c = 0.635` turns the mean of a normal error's logarithm into that of its size;
`q68`, `q95` are quantiles on held-out experiments. Networks are plain arrays, three in parallel.

Invariants: no file and no training library here; a wave outside of the training domain is refused, not
extrapolated.

Dimensionless features of the learned correction: one function for training and for a live record.

    level   = sqrt(noise^2 + FLOOR^2 + interval^4)        error of a harmonic
    missed  = (y_k - y_k of the start)/level, clipped     k = 2 ... 5, both parts

Order: start values; gain ratio, lag and describing-function estimates `T_df/Pu`, `D_df/Pu`; peak and duty; higher
harmonics; level of noise, sampling, hysteresis, cycles, error of the gain; residual of the start.

Conversion of the learned correction's dimensionless coordinates to process models.

    T = (wT) Pu/2 pi,  D = (wD) Pu/2 pi,  m = (mw^2) (Pu/2 pi)^2,  K = r A1/U1   (over Pu/2 pi when integrating)

Standard errors follow by the derivative: that of a logarithm is relative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.limit_cycle.harmonic_start import start
from autotuner.core.identification.limit_cycle.relay_harmonics import wave_of
from autotuner.core.identification.result import Estimate, refuse
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped
from autotuner.core.signals.noise import noise_sigma
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.core.identification.limit_cycle.harmonic_start import Starts
    from autotuner.core.identification.limit_cycle.relay_harmonics import RelayWaves
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

LEARNED = "learned"
LOG_NORMAL = 0.635
"""Minus the mean of `log |z|` of a standard normal `z`."""
CLASSES = ("fopdt", "sopdt_overdamped", "sopdt_underdamped", "integrating")
NOT_LOADED = "no trained correction is loaded"
BESIDE = "a controller ran in parallel with the relay, and the training was on the relay alone"
GAIN_UNKNOWN = "the static gain is not known: give it, or use an asymmetric relay"
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
    """Domain of the training: a box of features, and a distance from their mean in their own scatter."""

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
    """Trained correction of one structure.

    Attributes
    ----------
    networks : callable, such as Networks
        Spread of the start's error, mean of it in that spread, spread of the rest.
    q68, q95 : array of float, shape (P,)
        Quantiles of the error over its predicted standard error.
    domain : Domain
        Where it may be used.
    least, most : array of float, shape (P,)
        Range of the processes trained on, in the structure's coordinates.
    """

    networks: Callable[[FloatArray], FloatArray]
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
    """All corrections by structure, and the networks that classify structures."""

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
        Samples so far.
    structure : str or None
        Structure wanted; the likeliest when None.
    gain : (float, float) or None
        Static gain and its standard error, PV/output; that of the relay's asymmetry when None.
    models : LearnedModels, str or None
        Trained models, or the reason for their absence.
    sign : float
        A number of the sign of the process's gain, where none is given.
    fallback : (float, float) or None
        As `gain`, for a relay without asymmetry.
    """
    if not isinstance(models, LearnedModels):
        return refuse(LEARNED, models or NOT_LOADED)
    sign = math.copysign(1.0, sign if gain is None else gain[0])
    wave = wave_of(recording, sigma_of(recording), sign)
    if wave is None:
        return refuse(LEARNED, "the recording holds no oscillation under a relay")
    return by_wave(wave, structure, gain, models, sign, fallback)


def by_wave(
    wave: RelayWaves,
    structure: str | None,
    gain: tuple[float, float] | None,
    models: LearnedModels,
    sign: float,
    fallback: tuple[float, float] | None = None,
) -> Estimate:
    """Return the learned estimate of an oscillation; parameters as in `by_learned`."""
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
        return refuse(LEARNED, GAIN_UNKNOWN, evidence)
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
        return refuse(LEARNED, f"outside of the training domain: {beyond:.2g} times as far as its edge", evidence)
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
    """Return the gain times `U1/A1` and its relative error, or None for an unknown gain."""
    shown, error = float(wave.gain[0]), float(wave.gain_error[0])
    if gain is None and shown > 0.0 and error < SURE * shown:
        return shown, error / shown
    known = gain or fallback
    if known is None:
        return None
    return abs(known[0]) * float(wave.U1[0] / wave.A1[0]), known[1] / abs(known[0])


def sigma_of(recording: Recording) -> float:
    """Return the noise that was measured at rest, else that of the recording, PV units."""
    measured = recording.settings.get("noise_sigma")
    return measured if isinstance(measured, float) and measured >= 0.0 else noise_sigma(recording.pv)


FLOOR = 1e-5
"""Level of a harmonic's error without noise, over the fundamental."""
CLIP = 6.0
"""Largest error of a harmonic, in its own standard deviations, that the trained models have seen."""
GAIN_FLOOR = 1e-5
"""Relative error of a gain without noise: keeps the logarithm of the feature finite."""
FINEST = 1.0 / 400.0
"""Finest sample interval in periods that the trained models have seen."""
MOST_CYCLES = 3.0
"""Limits of the sample interval over the period, and of full cycles, to which the features are clipped."""


def features(wave: RelayWaves, r: FloatArray, gain_error: FloatArray, start: Starts) -> FloatArray:
    """Return the features, shape (B, F).

    Parameters
    ----------
    wave : RelayWaves
        The oscillations.
    r, gain_error : array of float, shape (B,)
        Static gain times `U1/A1`, and its relative standard error; 1 and 0 when integrating.
    start : Starts
        Start values of the structure.
    """
    interval, cycles = np.maximum(wave.interval, FINEST), np.minimum(wave.cycles, MOST_CYCLES)
    level = np.sqrt(wave.noise**2 + FLOOR**2 + interval**4)
    missed = start.missed[:, 1:] / level[:, None]
    lag = -np.angle(wave.y[:, 0]) % (2.0 * math.pi)
    T_df = np.sqrt(np.maximum((r / wave.peak) ** 2 - 1.0, 0.0))
    D_df = math.pi - np.arctan(T_df)
    columns = (
        start.values,
        np.stack((np.log(r), lag, np.log1p(T_df), D_df), axis=1),
        np.stack((np.log(wave.peak), wave.duty - 0.5), axis=1),
        np.log(np.abs(wave.y[:, 1:]) / (np.abs(wave.u[:, 1:]) + 0.05) + level[:, None]),
        np.log(np.stack((level, interval, cycles, gain_error + GAIN_FLOOR), axis=1)),
        np.stack((wave.hysteresis, np.log(start.misfit + level)), axis=1),
        np.clip(missed.real, -CLIP, CLIP),
        np.clip(missed.imag, -CLIP, CLIP),
    )
    return np.concatenate(columns, axis=1)


def model_of(structure: str, values: FloatArray, wave: RelayWaves, sign: float) -> ProcessModel | None:
    """Return the process, or None where the structure has none with these coordinates."""
    unit_s = float(wave.Pu[0]) / (2.0 * math.pi)
    K = sign * math.exp(values[-1]) * float(wave.A1[0] / wave.U1[0])
    D = max(float(values[-2]), 0.0) * unit_s
    try:
        return _MODELS[structure](K, D, [float(v) for v in values[:-2]], unit_s)
    except InputError:
        return None


def intervals(structure: str, values: FloatArray, errors: FloatArray, model: ProcessModel) -> dict[str, float]:
    """Return the errors of the parameters, in their units, from those of the coordinates."""
    parameters = model.parameters()
    unit_s = parameters["D"] / float(values[-2]) if values[-2] > 0.0 else 0.0
    found = {"K": abs(parameters["K"]) * float(errors[-1]), "D": unit_s * float(errors[-2])}
    names = [name for name in parameters if name not in {"K", "D"}]
    if structure == "integrating":
        return found | {"T": (parameters["T"] + unit_s) * float(errors[0])}
    return found | {name: parameters[name] * float(error) for name, error in zip(names, errors, strict=False)}


def _overdamped(K: float, D: float, lags: list[float], unit_s: float) -> ProcessModel:
    """Return the coordinates with the longer lag first; nearly equal ones may be in the other order."""
    T1, T2 = sorted((math.exp(v) * unit_s for v in lags), reverse=True)
    return SopdtOverdamped(K, T1, T2, D)


def _underdamped(K: float, D: float, pair: list[float], unit_s: float) -> ProcessModel:
    return SopdtUnderdamped(K, math.exp(pair[0]) * unit_s**2, math.exp(pair[1]) * unit_s, D)


_MODELS: dict[str, Callable[[float, float, list[float], float], ProcessModel]] = {
    "fopdt": lambda K, D, lag, unit_s: Fopdt(K, math.exp(lag[0]) * unit_s, D),
    "sopdt_overdamped": _overdamped,
    "sopdt_underdamped": _underdamped,
    "integrating": lambda K, D, lag, unit_s: Integrating(K / unit_s, max(math.expm1(lag[0]), 0.0) * unit_s, D),
}
