"""Gains of every goal with their predicted responses.

Invariants: a goal without gains for a process is omitted, never guessed; displayed gains are those that an apply would
write: same process, same range, same sample time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from autotuner.application.analysis.analysed import Context, context_from
from autotuner.core.design import GOALS, Basis, DesignSpec, design_from_spec, known_within, noise_of, with_prediction
from autotuner.core.design.simulation.closed_loop_setup import PLAIN, Installed
from autotuner.core.model.process import model_from_dict
from autotuner.errors import InputError, RecordingError
from autotuner.reports.curves import loop_curves

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.application.analysis.analysed import Analysis
    from autotuner.core.design import PidDesign
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording


class Recorded(Protocol):
    """A source of recordings, of this run of a service or of an earlier one."""

    def recording(self) -> Recording:
        """Return it; raise `RecordingError` where it has fewer than two samples."""


@dataclass(frozen=True, slots=True)
class Offer:
    """Gains that can be chosen."""

    spec: DesignSpec
    gains: PidDesign

    def predicted(self, basis: Basis, installed: Installed) -> Offer:
        """Return the choice with the predicted response of the loop."""
        return Offer(self.spec, with_prediction(self.gains, basis, installed))

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; `requested` is the body of a request for these gains."""
        result = {name: value for name, value in self.gains.to_dict().items() if name != "alternatives"}
        plain = DesignSpec().to_dict()
        requested = {
            name: value for name, value in self.spec.to_dict().items() if value != plain[name] or name == "goal"
        }
        return {"name": self.spec.name, "asked": requested, **result}


@dataclass(frozen=True, slots=True)
class ReportedEffect:
    """An effect that a diagnosis reported."""

    name: str
    parameters: Mapping[str, float]


def offers_of(basis: Basis, spec: DesignSpec) -> list[Offer]:
    """Return the gains of every goal, and the requested ones where they differ from all."""
    wishes = {other.name: other for other in (*map(DesignSpec, GOALS), spec)}
    made = [(other, _gains(basis, other)) for other in wishes.values()]
    return [Offer(other, gains) for other, gains in made if gains is not None]


def _gains(basis: Basis, spec: DesignSpec) -> PidDesign | None:
    """Return the gains; None for a process that has none of this kind."""
    try:
        return design_from_spec(basis, spec, compared=False)
    except InputError:
        return None


def choices_of(basis: Basis, spec: DesignSpec, installed: Installed = PLAIN) -> list[dict[str, Any]]:
    """Return the choices with their predicted responses, JSON-ready: figures and curves are of one simulation.

    Parameters
    ----------
    basis : Basis
        What the gains rest on, with the controller that will hold them.
    spec : DesignSpec
        The requested design, in addition to the goals.
    installed : Installed
        The loop that they are for.
    """
    offers = [offer.predicted(basis, installed) for offer in offers_of(basis, spec)]
    run = [offer.gains.held.gains if offer.gains.held else offer.gains.gains for offer in offers]
    curves = loop_curves(basis.model, run, installed)
    return [{**offer.to_dict(), "responses": curve} for offer, curve in zip(offers, curves, strict=True)]


def recording_of(tuning: Recorded) -> Recording | None:
    """Return the recording of a tuning; None before the second sample."""
    try:
        return tuning.recording()
    except RecordingError:
        return None


def fitted_until_s(analysis: Analysis | None) -> float | None:
    """Return where the fitted part of a record ends, s; None where that is not known."""
    if analysis is None or analysis.identification.recording is None:
        return None
    return float(analysis.identification.recording.t[-1])


def basis_from_result(result: Mapping[str, Any], recording: Recording | None) -> Basis:
    """Return the basis of the gains of a tuning, from its result, which must have a model."""
    estimate = result["estimates"].get(result["recommended"]) or {}
    model = model_from_dict(result["model"], result["structure"])
    covariances = (_matrix(estimate.get(name)) for name in ("covariance", "pair_covariance"))
    covariance, known_as = known_within(model, *covariances)
    interval_s = recording.sample_interval_s if recording else result["settings"]["sample_time_s"]
    sigma, rmse = (np.nan if (value := result["fit"][name]) is None else value for name in ("noise_sigma", "rmse"))
    context, step = context_from_result(result), result["fit"].get("resolution") or 0.0
    scan_s = (context.device.scan_s if context.device else 0.0) or interval_s
    noise = noise_of(sigma, rmse, interval_s, step)
    return Basis(model, covariance, scan_s, noise, known_as, context.device, context.output_span)


def _matrix(rows: Sequence[Sequence[float]] | None) -> FloatArray | None:
    return None if rows is None else np.array(rows, dtype=np.float64)


def installed_from_result(result: Mapping[str, Any], recording: Recording | None) -> Installed:
    """Return the loop of a tuning from its result.

    Parameters
    ----------
    result : mapping
        As `PidDesign.to_dict` makes it.
    recording : Recording or None
        Its recording: sets the size of the steps.
    """
    rest = (result.get("before") or {}).get("output")
    rest = rest if rest is not None else float(recording.output[0]) if recording else 0.0
    effects = [
        ReportedEffect(effect["name"], effect["parameters"])
        for effect in (result.get("diagnosis") or {}).get("effects") or ()
    ]
    return context_from_result(result).installed(recording, rest, effects)


def context_from_result(result: Mapping[str, Any]) -> Context:
    """Return the context of the loop; for a tuning that has not reported it, its limits and sample time."""
    if result.get("context"):
        return context_from(result["context"])
    settings = result.get("settings") or {}
    limits = settings.get("limits") or {}
    low, high = limits.get("output") or (-np.inf, np.inf)
    return Context(None, settings.get("sample_time_s") or 0.0, (low, high), limits.get("output_slew_per_s") or np.inf)
