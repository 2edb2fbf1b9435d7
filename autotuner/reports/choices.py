"""The gains of every goal side by side, with what they will do.

Rules of this file: a goal for which a process has no gains is left out, never guessed; what is offered is what would be
written: same process, same region, same sample time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from autotuner.core.process import model_from_dict
from autotuner.core.tuning import GOALS, Basis, Wish, gains_as_wished, known_within, noise_of
from autotuner.core.tuning.installed import PLAIN, Installed, handy
from autotuner.errors import InputError, RecordingError
from autotuner.reports.curves import loop_curves

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.configuration import GainsTable
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import HeldGains, PidGains
    from autotuner.core.tuning import Tuning as Gains


class Recorded(Protocol):
    """What has a recording, of this run of a service or of an earlier one."""

    def recording(self) -> Recording:
        """Return it; raise `RecordingError` where it has fewer than two samples."""


@dataclass(frozen=True, slots=True)
class Offer:
    """Gains that can be chosen."""

    wish: Wish
    gains: Gains

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; `asked` is the body of a request for these gains."""
        told = {name: value for name, value in self.gains.to_dict().items() if name != "alternatives"}
        plain = Wish().to_dict()
        asked = {name: value for name, value in self.wish.to_dict().items() if value != plain[name] or name == "goal"}
        return {"name": self.wish.name, "asked": asked, **told}


@dataclass(frozen=True, slots=True)
class ToldEffect:
    """An effect that a diagnosis told."""

    name: str
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class OnOffer:
    """What can be chosen for a loop, and what its device makes of it.

    Attributes
    ----------
    offers : sequence of Offer
        The gains.
    held : mapping of str to HeldGains
        What the device would hold, by the name of the wish; what it cannot hold is left out.
    derivative_filter : float or None
        `N` of the device's own filter of the derivative.
    """

    offers: Sequence[Offer]
    held: Mapping[str, HeldGains] = field(default_factory=dict)
    derivative_filter: float | None = None


def offers_of(basis: Basis, wish: Wish) -> list[Offer]:
    """Return the gains of every goal, and those that were asked for where that was something else."""
    wishes = {other.name: other for other in (*map(Wish, GOALS), wish)}
    made = [(other, _gains(basis, other)) for other in wishes.values()]
    return [Offer(other, gains) for other, gains in made if gains is not None]


def _gains(basis: Basis, wish: Wish) -> Gains | None:
    """Return the gains; None for a process that has none of this kind."""
    try:
        return gains_as_wished(basis, wish)
    except InputError:
        return None


def in_device(
    offers: Sequence[Offer],
    model: ProcessModel,
    hold: Callable[[PidGains, ProcessModel], HeldGains | None],
    table: GainsTable | None,
) -> OnOffer:
    """Return the gains with what a device would hold of them; `hold` says what that is."""
    found = {offer.wish.name: hold(offer.gains.gains, model) for offer in offers}
    held = {name: gains for name, gains in found.items() if gains is not None}
    return OnOffer(offers, held, table.derivative_filter if table else None)


def choices_of(basis: Basis, on_offer: OnOffer, installed: Installed = PLAIN) -> list[dict[str, Any]]:
    """Return what is offered with its predicted responses, JSON-ready.

    Parameters
    ----------
    basis : Basis
        What the gains rest on.
    on_offer : OnOffer
        The gains; what the device would hold of them is predicted.
    installed : Installed
        The loop that they are for.
    """
    held = [on_offer.held.get(offer.wish.name) for offer in on_offer.offers]
    made = [found.gains if found else offer.gains.gains for offer, found in zip(on_offer.offers, held, strict=True)]
    curves = loop_curves(basis.model, made, installed)
    return [
        {**offer.to_dict(), "responses": curve, "device": found.to_dict() if found else None}
        for offer, found, curve in zip(on_offer.offers, held, curves, strict=True)
    ]


def recording_of(tuning: Recorded) -> Recording | None:
    """Return what a tuning has recorded; None before the second sample."""
    try:
        return tuning.recording()
    except RecordingError:
        return None


def basis_told(told: Mapping[str, Any], recording: Recording | None) -> Basis:
    """Return what the gains of a tuning rest on, from what it told, which must have a model."""
    estimate = told["estimates"].get(told["recommended"]) or {}
    model = model_from_dict(told["model"], told["structure"])
    covariances = (_matrix(estimate.get(name)) for name in ("covariance", "pair_covariance"))
    covariance, known_as = known_within(model, *covariances)
    interval_s = recording.sample_interval_s if recording else told["settings"]["sample_time_s"]
    sigma, rmse = (np.nan if (value := told["fit"][name]) is None else value for name in ("noise_sigma", "rmse"))
    return Basis(model, covariance, interval_s, noise_of(sigma, rmse, interval_s), known_as)


def _matrix(told: Sequence[Sequence[float]] | None) -> FloatArray | None:
    return None if told is None else np.array(told, dtype=np.float64)


def installed_told(
    told: Mapping[str, Any], recording: Recording | None, derivative_filter: float | None = None
) -> Installed:
    """Return the loop of a tuning from what it told.

    Parameters
    ----------
    told : mapping
        As `Tuning.to_dict` makes it.
    recording : Recording or None
        What it recorded: tells the size of the steps.
    derivative_filter : float, optional
        `N` of the device's own filter of the derivative.
    """
    settings = told.get("settings") or {}
    limits = settings.get("limits") or {}
    rest = (told.get("before") or {}).get("output")
    rest = rest if rest is not None else float(recording.output[0]) if recording else 0.0
    low, high = limits.get("output") or (-np.inf, np.inf)
    diagnosis = told.get("diagnosis") or {}
    return Installed(
        settings.get("sample_time_s") or 0.0,
        (min(low - rest, 0.0), max(high - rest, 0.0)),
        limits.get("output_slew_per_s") or np.inf,
        derivative_filter,
        rest,
        tuple(ToldEffect(effect["name"], effect["parameters"]) for effect in diagnosis.get("effects") or ()),
        *_steps(recording),
    )


def _steps(recording: Recording | None) -> tuple[float, float]:
    """Return steps of set point and load of a size that the record has shown: half and a quarter of its swing."""
    if recording is None:
        return 1.0, 1.0
    return handy(float(np.ptp(recording.pv)) / 2.0), handy(float(np.ptp(recording.output)) / 4.0)
