"""What the identification returns: limit cycle, estimates with their errors, and the identification as a whole.

Rules of this file:

1. Results are frozen values; what follows from others is a property.
2. A method that does not apply says so in a sentence (`refusal`) instead of raising: methods stand side by side.
3. `to_dict` is JSON-ready and never holds NaN or infinity: what is not known is None.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from autotuner.core.arrays import FloatArray  # noqa: TC001 - part of the public signature
from autotuner.core.process import ProcessModel, model_to_dict
from autotuner.core.verdict import Verdict  # noqa: TC001 - part of the public signature


@dataclass(frozen=True, slots=True)
class LimitCycle:
    """The steady oscillation under a relay, measured over whole cycles.

    Attributes
    ----------
    Pu : float
        Period, s.
    A, A1 : float
        PV amplitude, zero to peak: of the wave itself, and of its fundamental.
    h, bias : float
        Half the relay's swing and its centre, output units.
    relay_fundamental : float
        Amplitude of the relay wave's fundamental, output units; `4 h/pi` when the half periods are equal.
    hysteresis : float
        Half the distance of the PV at the two switches, PV; what the relay really showed, sampling included.
    high_s, low_s : float
        Half periods at the upper and at the lower output level, s.
    lowest, highest : float
        Extremes of the PV.
    pv_at_rise, pv_at_fall : float
        PV at the moments at which the output turned high, and low.
    cycles : int
        Whole cycles averaged.
    relative_error : mapping of str to float
        Relative standard errors of `Pu`, `A`, `A1` over the cycles; empty when there are too few to tell.
    """

    Pu: float
    A: float
    A1: float
    h: float
    bias: float
    relay_fundamental: float
    hysteresis: float
    high_s: float
    low_s: float
    lowest: float
    highest: float
    pv_at_rise: float
    pv_at_fall: float
    cycles: int
    relative_error: Mapping[str, float] = field(default_factory=dict)

    @property
    def Ku(self) -> float:
        """Ultimate gain from the peak, `4 h/(pi A)` (thesis eq. 3.3), output/PV."""
        return 4.0 * self.h / (math.pi * self.A)

    @property
    def Ku_fundamental(self) -> float:
        """Ratio of the two fundamentals: exactly `1/|G(jw)|` at the period of the cycle, output/PV."""
        return self.relay_fundamental / self.A1

    @property
    def duty(self) -> float:
        """Share of the period at the upper level."""
        return self.high_s / self.Pu

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        names = ("Pu", "A", "A1", "Ku", "Ku_fundamental", "h", "bias", "relay_fundamental", "hysteresis", "high_s")
        names += ("low_s", "lowest", "highest", "pv_at_rise", "pv_at_fall", "cycles", "relative_error")
        return {name: plain(getattr(self, name)) for name in names}


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What one method says.

    Attributes
    ----------
    method : str
        Stable name such as ``least_squares``.
    model : ProcessModel or None
        The process; None when the method does not apply.
    standard_error : mapping of str to float
        Standard error of each parameter, in its unit; empty when the method cannot tell.
    interval95 : mapping of str to (float, float)
        95 % interval of each parameter.
    covariance : array of float, shape (P, P), or None
        Covariance of the parameters, in the order of ``model.parameters()``.
    rmse, fit_percent : float
        Root mean square of measured minus simulated PV on the recording, PV, and `100 (1 - |e| / |pv - mean pv|)`;
        NaN when it was not simulated.
    refusal : str or None
        Why the method does not apply.
    evidence : mapping
        What the estimate rests on, JSON-ready.
    """

    method: str
    model: ProcessModel | None
    standard_error: Mapping[str, float] = field(default_factory=dict)
    interval95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    covariance: FloatArray | None = None
    rmse: float = math.nan
    fit_percent: float = math.nan
    refusal: str | None = None
    evidence: Mapping[str, object] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "method": self.method,
            "structure": None if self.model is None else self.model.structure,
            "model": None if self.model is None else self.model.parameters(),
            "standard_error": plain(self.standard_error),
            "interval95": plain(self.interval95),
            "covariance": plain(self.covariance),
            "rmse": plain(self.rmse),
            "fit_percent": plain(self.fit_percent),
            "refusal": self.refusal,
            "evidence": plain(self.evidence),
        }


def refuse(method: str, sentence: str, evidence: Mapping[str, object] | None = None) -> Estimate:
    """Return the estimate of a method that does not apply."""
    return Estimate(method, None, refusal=sentence, evidence=evidence or {})


@dataclass(frozen=True, slots=True)
class Fit:
    """How well the recommended model repeats the recording.

    Attributes
    ----------
    rmse : float
        Root mean square of measured minus simulated PV, PV.
    fit_percent : float
        `100 (1 - |e| / |pv - mean pv|)`.
    noise_sigma : float
        Standard deviation of the noise, measured without a model, PV.
    """

    rmse: float = math.nan
    fit_percent: float = math.nan
    noise_sigma: float = math.nan

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {name: plain(getattr(self, name)) for name in ("rmse", "fit_percent", "noise_sigma")}


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Everything that a recording told.

    Attributes
    ----------
    model : ProcessModel or None
        The recommended model; None when the verdict is a refusal.
    limit_cycle : LimitCycle or None
        The oscillation, when the recording is a relay test.
    estimates : mapping of str to Estimate
        What each method says, by its name.
    recommended : str or None
        Name of the estimate that `model` comes from.
    fit : Fit
        Quality of the recommended model on this recording.
    warnings : tuple of str
        What the user has to know before using the model.
    verdict : Verdict
        ``done`` or ``refused``, with numbers and advice.
    """

    model: ProcessModel | None
    limit_cycle: LimitCycle | None
    estimates: Mapping[str, Estimate]
    recommended: str | None
    verdict: Verdict
    fit: Fit = field(default_factory=Fit)
    warnings: tuple[str, ...] = ()

    @property
    def structure(self) -> str | None:
        """Structure of the recommended model."""
        return None if self.model is None else self.model.structure

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "structure": self.structure,
            "model": None if self.model is None else self.model.parameters(),
            "limit_cycle": None if self.limit_cycle is None else self.limit_cycle.to_dict(),
            "estimates": {name: estimate.to_dict() for name, estimate in self.estimates.items()},
            "recommended": self.recommended,
            "fit": self.fit.to_dict(),
            "warnings": list(self.warnings),
            "verdict": self.verdict.to_dict(),
        }


def plain(value: object) -> object:
    """Return a JSON-ready copy: arrays as lists, what is not finite as None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return model_to_dict(value) if isinstance(value, ProcessModel) else value
