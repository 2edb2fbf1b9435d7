"""Result of a diagnosis: verdict, effects with their sizes; errors, model and gains before and after.

Invariants: frozen values; `to_dict` is JSON-ready and never holds NaN; unknown values are None.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from autotuner.core.diagnosis.findings.effect_units import unit_of
from autotuner.core.jsonable import jsonable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.diagnosis.findings.residual_dependence import Dependence
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

NOT_SETTLED = "not_settled"
"""Effect of a process that was still moving when the record began."""
Outcome = Literal["adequate", "explained", "partly_explained", "unexplained"]


def comes_from_outside(name: str, place: str) -> bool:
    """Return whether an effect acts from outside, or did before the test: the process is the same without it."""
    return place == "disturbance" or name == NOT_SETTLED


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """One effect in the recording.

    Attributes
    ----------
    name, place : str
        From the catalogue.
    parameters : mapping of str to float
        Its sizes, in `units`.
    interval95 : mapping of str to (float, float)
        95 % intervals of the sizes.
    confidence : float
        Share of the evidence that this effect has among all that were tried in its place, 0 to 1.
    indistinguishable : tuple of str
        Other effects that explain this record about as well.
    form : str
        Which form of the effect fits best, where it has several.
    advice : str
        Advice.
    at_its_place : float, optional
        Share of the evidence of this effect together with all others at its place: the process without them is
        nearly the same. Defaults to `confidence`.
    """

    name: str
    place: str
    parameters: Mapping[str, float]
    interval95: Mapping[str, tuple[float, float]]
    confidence: float
    indistinguishable: tuple[str, ...] = ()
    form: str = ""
    advice: str = ""
    at_its_place: float | None = None

    @property
    def title(self) -> str:
        """Name, and the form where it has several."""
        return f"{self.name}, {self.form}" if self.form else self.name

    @property
    def units(self) -> dict[str, str]:
        """Units of the sizes, in terms of ``output`` and ``PV``; empty for ratios."""
        return {name: unit_of(self.place, name) for name in self.parameters}

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "name": self.name,
            "place": self.place,
            "form": self.form,
            "parameters": jsonable(self.parameters),
            "interval95": jsonable(self.interval95),
            "units": self.units,
            "confidence": jsonable(self.confidence),
            "indistinguishable": list(self.indistinguishable),
            "advice": self.advice,
        }


@dataclass(frozen=True, slots=True)
class Misfit:
    """Root mean square errors on one part of the record, PV units.

    Attributes
    ----------
    before, after : float
        Measured minus simulated PV, without and with the effects.
    noise : float
        Standard deviation of the noise, once for the whole record.
    expected : float
        Error of a perfect model: noise, the sensor's own effects (quantisation, uneven sampling), and unknown delays
        of moves.
    """

    before: float
    after: float
    noise: float
    expected: float

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {name: jsonable(getattr(self, name)) for name in ("before", "after", "noise", "expected")}


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Data of the pictures: measured PV, simulated PV before and after, and the start of the test part."""

    t: FloatArray
    output: FloatArray
    pv: FloatArray
    before: FloatArray
    after: FloatArray
    held_out_from_s: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Diagnosis:
    """Diagnosis of a recording: fit of the model, and effects that the model lacks.

    Attributes
    ----------
    verdict : str
        ``adequate``: this record shows no missing effect. ``explained``: with the effects below only noise remains.
        ``partly_explained``: the effects explain a good part of the error, and are hypotheses. ``unexplained``:
        an unknown effect is missing. Model and gains after are those with the effects
        where the verdict is ``explained``, and those before otherwise.
    effects : tuple of FoundEffect
        Missing effects, the largest first; hypotheses where the verdict is not ``explained``.
    runner_up : mapping or None
        The next best explanation that is not among the effects, with its error on both parts.
    error : mapping of str to Misfit
        ``fitted``; ``selection``, which chose among explanations; ``held_out``, the test part, which chose nothing.
    model, gains : mapping
        ``before`` and ``after``: process parameters with intervals, and the gains that follow with their margins.
    notes : tuple of str
        Notes: repairs, effects that the record cannot show, the residual.
    summary : str
        The verdict in a sentence.
    traces : Traces or None
        For pictures.
    process : ProcessModel or None
        The process without the effects.
    covariance : array of float, shape (P, P), or None
        Covariance of its parameters, in the order of ``process.parameters()``.
    blocks : tuple of Misfit
        The errors of five equal parts of a long record, in the order of time; empty for a short one.
    missing : tuple of Dependence
        Where the record is not explained: dependence of the residual of the model without effects.
    """

    verdict: Outcome
    effects: tuple[FoundEffect, ...]
    runner_up: Mapping[str, object] | None
    error: Mapping[str, Misfit]
    model: Mapping[str, object]
    gains: Mapping[str, object]
    notes: tuple[str, ...]
    summary: str = ""
    traces: Traces | None = field(default=None, repr=False)
    process: ProcessModel | None = None
    covariance: FloatArray | None = field(default=None, repr=False)
    blocks: tuple[Misfit, ...] = ()
    missing: tuple[Dependence, ...] = ()

    def __repr__(self) -> str:
        return f"<Diagnosis {self.verdict}: {self.summary}>"

    @property
    def disturbances_alone(self) -> bool:
        """Whether all effects are external, or acted before the test: the process is known without them."""
        passing = (comes_from_outside(effect.name, effect.place) for effect in self.effects)
        return bool(self.effects) and all(passing)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values, without traces and covariance."""
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "effects": [effect.to_dict() for effect in self.effects],
            "runner_up": jsonable(self.runner_up),
            "error": {part: misfit.to_dict() for part, misfit in self.error.items()},
            "blocks": [misfit.to_dict() for misfit in self.blocks],
            "missing": [one.to_dict() for one in self.missing],
            "model": jsonable(self.model),
            "gains": jsonable(self.gains),
            "notes": list(self.notes),
        }
