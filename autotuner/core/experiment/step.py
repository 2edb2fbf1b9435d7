"""Result of a stage of the experiment for a sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from autotuner.core.experiment.baseline import Baseline
    from autotuner.core.experiment.phases import PhaseEvent
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class RunningEstimate:
    """Estimate after a half period, over the last full period.

    Attributes
    ----------
    half_period : int
        Half periods since the relay was last moved.
    period_s, peak, fundamental : float
        Pu, A and A1 of the last period, s and PV.
    ultimate_gain : float
        Ku = 4 h / (pi A), output/PV (describing function, thesis eq. 3.3); NaN with a parallel controller, where the
        relay's gain is not the ultimate gain.
    """

    half_period: int
    period_s: float
    peak: float
    fundamental: float
    ultimate_gain: float


@dataclass(frozen=True, slots=True)
class Step:
    """Result of a stage for a sample: the output, and the event or verdict at its end.

    Attributes
    ----------
    output : float
        Output to hold from this sample on, output units.
    event : PhaseEvent or None
        What moves the phase on.
    following : Stage or None
        The stage that takes the next sample; None: this one.
    verdict : Verdict or None
        A refusal that ends the experiment.
    estimate : RunningEstimate or None
        When the sample completed a half period.
    warning : str or None
        Warnings for the user while the experiment continues.
    segment : str or None
        Name of the part of the record that begins with this sample.
    baseline : Baseline or None
        The baseline of later samples, once it is known.
    """

    output: float
    event: PhaseEvent | None = None
    following: Stage | None = None
    verdict: Verdict | None = None
    estimate: RunningEstimate | None = None
    warning: str | None = None
    segment: str | None = None
    baseline: Baseline | None = None


class Stage(Protocol):
    """A part of the experiment that decides the output."""

    def step(self, sample: Sample) -> Step:
        """Process one sample and return the output from then on."""
