"""What is known of a verification: what it is about, what was predicted, what was measured, how it ended."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.verdict import Outcome

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Sample
    from autotuner.core.tuning import PidSettings, Scenario
    from autotuner.core.tuning.actuators import Named
    from autotuner.core.tuning.verification import Band
    from autotuner.core.tuning.verification_plan import Rest
    from autotuner.core.verdict import Verdict
    from autotuner.runtime.apply import RolledBack

TIMES_TO_SETTLE = 3.0
"""Dead and integral times after which the first move of a controller has died away."""
SHOWN = 300
"""Most points of a response in a result."""


@dataclass(frozen=True, slots=True)
class Claim:
    """What is to be verified: a controller that the device has, and the process that it was designed for.

    Attributes
    ----------
    model : ProcessModel
        The process.
    covariance : array of float or None
        Covariance of its parameters.
    settings : PidSettings
        The controller as the device runs it.
    step : float or None
        Step of the set point that is wanted, PV units.
    scan_s : float
        How often the device's controller runs, s: so much later than known it may act.
    effects : tuple of Named
        What a diagnosis has found beside the process.
    """

    model: ProcessModel
    covariance: FloatArray | None
    settings: PidSettings
    step: float | None = None
    scan_s: float = 0.0
    effects: tuple[Named, ...] = ()

    @property
    def settling_s(self) -> float:
        """Time that a controller which has just taken over is left alone, s."""
        Ti = self.settings.gains.Ti
        return TIMES_TO_SETTLE * (self.model.D + (Ti if math.isfinite(Ti) else 0.0))


@dataclass(slots=True)
class VerificationRun:
    """A verification with all that is known of it now.

    Attributes
    ----------
    verdict : Verdict or None
        How it ended: `done` passed; `refused` with the code `not_as_predicted` is the judge's word.
    rolled_back : bool
        Whether the old gains are back because of it.
    scenario : Scenario or None
        The step that was made.
    band : Band or None
        What was predicted, deviations from rest.
    rest : Rest or None
        The loop before the step.
    samples : list of Sample
        The response; times from the step.
    reason : Verdict or None
        Why it ended, before anything was put back; kept out of what is told, because the verdict says it.
    settled : bool
        Whether nothing is left to be put back; kept out of what is told, because the verdict says it.
    back : RolledBack or None
        How the old gains came back, where that was left to a later program.
    """

    verdict: Verdict | None = None
    rolled_back: bool = False
    scenario: Scenario | None = None
    band: Band | None = None
    rest: Rest | None = None
    samples: list[Sample] = field(default_factory=list)
    reason: Verdict | None = None
    settled: bool = False
    back: RolledBack | None = None

    @property
    def passed(self) -> bool:
        """Whether the loop did what was predicted."""
        return self.verdict is not None and self.verdict.outcome is Outcome.DONE

    @property
    def overshoot(self) -> float | None:
        """Measured overshoot, share of the step; mean of three samples, so that one noisy one is none."""
        if self.scenario is None or self.rest is None or len(self.samples) < 3 or not self.scenario.set_point_step:
            return None
        share = (np.array([s.pv for s in self.samples]) - self.rest.pv) / self.scenario.set_point_step
        return max(0.0, float(np.max(np.convolve(share, np.full(3, 1.0 / 3.0), "valid"))) - 1.0)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; of a long response some points only."""
        every = slice(None, None, max(1, len(self.samples) // SHOWN))
        return {
            "state": "running" if self.verdict is None else "ended",
            "passed": self.passed if self.verdict else None,
            "rolled_back": self.rolled_back,
            "verdict": self.verdict.to_dict() if self.verdict else None,
            "step": self.scenario.set_point_step if self.scenario else None,
            "duration_s": self.scenario.duration_s if self.scenario else None,
            "overshoot": self.overshoot,
            "predicted_overshoot": self.band.nominal.overshoot if self.band else None,
            "response": [[s.t, s.pv, s.output] for s in self.samples[every]],
            "predicted": self._predicted(),
        }

    def _predicted(self) -> list[list[float]]:
        if self.band is None or self.rest is None:
            return []
        every = slice(None, None, max(1, self.band.t.size // SHOWN))
        low, high = self.band.pv.low[every] + self.rest.pv, self.band.pv.high[every] + self.rest.pv
        return [list(row) for row in zip(self.band.t[every].tolist(), low.tolist(), high.tolist(), strict=True)]
