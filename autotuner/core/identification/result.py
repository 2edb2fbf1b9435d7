"""Results of the identification: limit cycle, estimates with their errors, and the identification as a whole.

Invariants:

1. Results are frozen values; derived values are properties.
2. A method that does not apply returns a sentence (`refusal`) instead of raising, so that methods can be compared.
3. `to_dict` is JSON-ready and never holds NaN or infinity: unknown values are None.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.frequency_points import FrequencyPoint  # noqa: TC001 - part of the public signature
from autotuner.core.jsonable import jsonable
from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature
from autotuner.core.model.process import ProcessModel, UnstableFopdt
from autotuner.core.notes import notes_among, warnings_among
from autotuner.core.recording import Recording  # noqa: TC001 - part of the public signature
from autotuner.core.verdict import Verdict  # noqa: TC001 - part of the public signature

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.signals.limit_cycle import LimitCycle

CLEAR = 2.0
"""Standard errors by which a gain must differ from zero: a smaller one is not a response and would bias the process."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Influence of a measured disturbance on the PV.

    Attributes
    ----------
    name : str
        Its column.
    gain, gain_error : float
        Static gain and its standard error, PV per unit; PV per unit and second for an integrating process.
    D, D_error : float
        Dead time and its standard error, s.
    """

    name: str
    gain: float
    gain_error: float
    D: float
    D_error: float

    @property
    def shows(self) -> bool:
        """Whether the PV answers to it."""
        return abs(self.gain) > CLEAR * self.gain_error

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "name": self.name,
            "gain": self.gain,
            "gain_error": self.gain_error,
            "D": self.D,
            "D_error": self.D_error,
        }


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimate:
    """The estimate of one method.

    Attributes
    ----------
    method : str
        Stable name such as ``least_squares``.
    model : ProcessModel or None
        The process; None when the method does not apply.
    standard_error : mapping of str to float
        Standard error of each parameter, in its unit; empty when the method has none.
    interval95 : mapping of str to (float, float)
        95 % interval of each parameter.
    covariance : array of float, shape (P, P), or None
        Covariance of the parameters, in the order of ``model.parameters()``.
    pair_covariance : array of float, shape (4, 4) or (5, 5), or None
        That of `(K, m, n, D)` or `(K, m, n, Z, D)`, `m` product and `n` sum of two lags that the record cannot separate
        apart; else None.
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
    pair_covariance: FloatArray | None = None

    def __repr__(self) -> str:
        if self.model is None:
            return f"<Estimate {self.method}: {self.refusal or 'does not apply'}>"
        values = ", ".join(f"{name} {value:.4g}" for name, value in self.model.parameters().items())
        return f"<Estimate {self.method}, {self.model.structure}: {values}>"

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "method": self.method,
            "structure": None if self.model is None else self.model.structure,
            "model": None if self.model is None else self.model.parameters(),
            "standard_error": jsonable(self.standard_error),
            "interval95": jsonable(self.interval95),
            "covariance": jsonable(self.covariance),
            "pair_covariance": jsonable(self.pair_covariance),
            "rmse": jsonable(self.rmse),
            "fit_percent": jsonable(self.fit_percent),
            "refusal": self.refusal,
            "evidence": jsonable(self.evidence),
        }


def refuse(method: str, sentence: str, evidence: Mapping[str, object] | None = None) -> Estimate:
    """Return the estimate of a method that does not apply."""
    return Estimate(method, None, refusal=sentence, evidence=evidence or {})


UNEXPLAINED = 0.25
"""Share of the PV's motion, beyond noise, that a model may leave unexplained before it is a guess."""
UNEXPLAINED_BY_UNSTABLE = 0.1
"""The same of an unstable model. A stable process with a load change also moves away from its level, and a diverging
exponential fits this to a tenth at best; an undisturbed unstable process leaves a twentieth."""


def most_unexplained(model: ProcessModel | None) -> float:
    """Return the share of the PV's motion, beyond noise, that a model may leave unexplained before it is a guess."""
    return UNEXPLAINED_BY_UNSTABLE if isinstance(model, UnstableFopdt) else UNEXPLAINED


def share_unexplained(rmse: float, sigma: float, pv: FloatArray) -> float:
    """Return the share of the PV's motion that neither a fit nor noise explains; 0 where the PV does not move.

        sqrt(max(rmse^2 - sigma^2, 0))/std(pv)

    Parameters
    ----------
    rmse : float
        Root mean square of measured minus simulated PV, PV units.
    sigma : float
        Standard deviation of the noise, PV units.
    pv : array of float, shape (N,)
        The PV, PV units.
    """
    moved = float(np.std(pv))
    return math.sqrt(max(rmse**2 - sigma**2, 0.0)) / moved if moved > 0.0 else 0.0


def what_looks_so(model: ProcessModel | None) -> str:
    """Return the note on other processes that resemble such a model; empty for most."""
    looks = "; a stable process whose load changes during the test, or whose actuator saturates, looks unstable"
    return looks if isinstance(model, UnstableFopdt) else ""


@dataclass(frozen=True, slots=True)
class Fit:
    """Fit of the recommended model to the recording.

    Attributes
    ----------
    rmse : float
        Root mean square of measured minus simulated PV, PV.
    fit_percent : float
        `100 (1 - |e| / |pv - mean pv|)`.
    noise_sigma : float
        Standard deviation of the noise, measured without a model, PV.
    unexplained : float
        Share of the PV's motion that neither the model nor noise or rounding explains, 0 to 1 and more.
    resolution : float
        Step of the sensor, PV; 0 where the PV is on no grid.
    """

    rmse: float = math.nan
    fit_percent: float = math.nan
    noise_sigma: float = math.nan
    unexplained: float = math.nan
    resolution: float = 0.0

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        names = ("rmse", "fit_percent", "noise_sigma", "unexplained", "resolution")
        return {name: jsonable(getattr(self, name)) for name in names}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Identification:
    """Everything that was identified from a recording.

    Attributes
    ----------
    model : ProcessModel or None
        The recommended model; None when the verdict is a refusal.
    limit_cycle : LimitCycle or None
        The oscillation, when the recording is a relay test.
    estimates : mapping of str to Estimate
        The estimate of each method, by its name.
    recommended : str or None
        Name of the estimate that `model` comes from.
    fit : Fit
        Quality of the recommended model on this recording.
    warnings : tuple of str
        What the user has to know before using the model.
    verdict : Verdict
        ``done`` or ``refused``, with numbers and advice.
    points : tuple of FrequencyPoint
        Points of the frequency response that the oscillation shows, whatever the structure; empty without one.
    recording : Recording or None
        What the model answers to: the recording, thinned out when it is very long, with the moments at which the
        output changed as they were estimated and without the answers to measured disturbances; None when refused. Not
        in `to_dict`.
    disturbances : tuple of Disturbance
        How the measured disturbances that were named move the PV.
    """

    model: ProcessModel | None
    limit_cycle: LimitCycle | None
    estimates: Mapping[str, Estimate]
    recommended: str | None
    verdict: Verdict
    fit: Fit = field(default_factory=Fit)
    warnings: tuple[str, ...] = ()
    points: tuple[FrequencyPoint, ...] = ()
    recording: Recording | None = None
    disturbances: tuple[Disturbance, ...] = ()

    def __repr__(self) -> str:
        if self.model is None:
            return f"<Identification {self.verdict.code}: {self.verdict.message}>"
        values = ", ".join(f"{name} {value:.4g}" for name, value in self.model.parameters().items())
        return f"<Identification {self.structure}: {values}; fit {self.fit.fit_percent:.1f} %>"

    @property
    def structure(self) -> str | None:
        """Structure of the recommended model."""
        return None if self.model is None else self.model.structure

    @property
    def is_a_guess(self) -> bool:
        """Whether the unexplained share is so large that gains for the model would be a guess."""
        return self.fit.unexplained > most_unexplained(self.model)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "structure": self.structure,
            "model": None if self.model is None else self.model.parameters(),
            "limit_cycle": None if self.limit_cycle is None else self.limit_cycle.to_dict(),
            "estimates": {name: estimate.to_dict() for name, estimate in self.estimates.items()},
            "recommended": self.recommended,
            "points": [point.to_dict() for point in self.points],
            "disturbances": [one.to_dict() for one in self.disturbances],
            "fit": self.fit.to_dict(),
            "warnings": warnings_among(self.warnings),
            "notes": notes_among(self.warnings),
            "verdict": self.verdict.to_dict(),
        }


@dataclass(frozen=True, slots=True)
class RunningModel:
    """A model of the record so far.

    Attributes
    ----------
    model : ProcessModel
        The simplest one that explains the PV.
    standard_error : mapping of str to float
        Of its parameters.
    relative_error : float
        The largest, see above.
    method : str
        ``least_squares`` or ``learned``.
    explains : bool
        Whether the PV is explained to within its noise.
    gains : mapping, or None
        Gains for it, with the `rule` of their design, JSON-ready; None without any.
    expected_loss : float
        Share by which the load error of the gains could still become less, see `expected_loss`; 0 where not known.
    """

    model: ProcessModel
    standard_error: Mapping[str, float]
    relative_error: float
    method: str = "least_squares"
    explains: bool = True
    gains: Mapping[str, object] | None = None
    expected_loss: float = 0.0
