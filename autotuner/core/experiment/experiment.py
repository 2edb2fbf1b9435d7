"""The relay experiment: one object, stepped by samples, that decides the output.

    arm -> quiet -> (approach) -> relay -> restore -> ended

Invariants:

1. `step(sample) -> command` touches nothing but the object's own state: no I/O, no clock. The same object runs live, in
   virtual time and in replay.
2. The experiment proposes an output; the safety supervisor (`core/safety`) decides finally on every write.
3. The experiment always ends: by convergence, by a refusal with numbers and advice, or by its time limit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from autotuner.core.experiment import refusals
from autotuner.core.experiment.parallel_controller import Parallel
from autotuner.core.experiment.phases import Phase, PhaseEvent, next_phase
from autotuner.core.experiment.relay import place_levels
from autotuner.core.experiment.relay_phase.check import HalfRelay, Holds, Return
from autotuner.core.experiment.relay_phase.displacement import Displacement
from autotuner.core.experiment.relay_phase.oscillation import Oscillation
from autotuner.core.experiment.stages import Rest
from autotuner.core.experiment.step import Step
from autotuner.core.notes import Note

if TYPE_CHECKING:
    from autotuner.core.experiment.baseline import Baseline
    from autotuner.core.experiment.relay import Levels
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.experiment.step import RunningEstimate, Stage
    from autotuner.core.model.process import Integrating
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

RETURN_MEAN = 0.25
"""Latest time over which the displacement of an integrating process is averaged, in Pu: noise is, its swing is not."""
LEFT_LINE = frozenset({"pv_drifts", "no_oscillation"})
"""Refusals of a relay about a moving reference after which a fixed one is tried."""
LEFT_LINE_NOTE = Note("the drift of the PV at rest did not go on as a line: the relay began again about a fixed value")


@dataclass(frozen=True, slots=True)
class Command:
    """Command of the experiment after a sample.

    Attributes
    ----------
    output : float
        Output to hold from this sample on, output units.
    phase : Phase
        Phase from this sample on.
    estimate : RunningEstimate or None
        The running estimate, when this sample completed a half period.
    """

    output: float
    phase: Phase
    estimate: RunningEstimate | None = None


class Experiment:
    """A relay experiment on one loop.

    Parameters
    ----------
    settings : ExperimentSettings
        How it is run.
    output : float
        Output before the experiment, to which it returns, output units.
    """

    def __init__(self, settings: ExperimentSettings, output: float) -> None:
        self.settings = settings
        self.initial_output = output
        self.phase = Phase.ARM
        self.verdict: Verdict | None = None
        self.warnings: list[str] = []
        self.segments: dict[str, float] = {}
        self._stage: Stage | None = None
        self._levels: Levels | None = None
        self._beside: Parallel | None = None
        self._started_s: float | None = None
        self._relay_seen: dict[str, object] = {}
        self._baseline: Baseline | None = None
        self._line_verdict: Verdict | None = None
        self._integrating: Integrating | None = None
        self._displacement = Displacement(output)

    def step(self, sample: Sample) -> Command:
        """Process one sample and return the output from then on."""
        if self.phase is Phase.ARM:
            self._arm(sample)
        if self._stage is None:
            return Command(self.initial_output, self.phase)
        if self._over_time(sample):
            self.stop(refusals.too_long(self.phase, self.settings.time_limit_s))
            return Command(self.initial_output, self.phase)
        return self._advance(self._stage, sample)

    def stop(self, verdict: Verdict) -> None:
        """End the experiment with `verdict` from any phase before its end; the first verdict counts."""
        self.phase = next_phase(self.phase, PhaseEvent.STOPPED)
        self.verdict = self.verdict or verdict
        self._stage = None

    def inform(self, model_error: float, expected_loss: float = 0.0, *, integrating: Integrating | None = None) -> None:
        """Take the uncertainty of a model that explains the record so far; it may end the relay phase, or prolong it.

        Parameters
        ----------
        model_error : float
            Largest relative standard error of its parameters.
        expected_loss : float
            Share by which the load error of gains for it exceeds that of a process known exactly.
        integrating : Integrating or None
            The process, where it integrates: its PV does not return without a move of the output.
        """
        self._integrating = integrating
        if isinstance(self._stage, Oscillation):
            self._stage.inform(model_error, expected_loss)

    def restored(self) -> None:
        """Record that output and mode are restored."""
        self.phase = next_phase(self.phase, PhaseEvent.RESTORED)

    def settings_so_far(self) -> dict[str, object]:
        """Return the settings of this experiment for its recording, JSON-ready.

        `segments` names the parts of the record with their start times, s; `direct` is the action that agreed with the
        PV's first response.
        """
        online = {} if self.settings.online is None else {"online": self.settings.online.to_dict()}
        drift = {} if self._baseline is None else {"drift_per_s": self._baseline.line.slope_per_s}
        settings = {
            "initial_output": self.initial_output,
            "direct": self.settings.direct,
            "segments": dict(self.segments),
        }
        return {**settings, **online, **drift, **self._relay_seen}

    def _arm(self, sample: Sample) -> None:
        low, high = self.settings.limits.output
        settings = self.settings
        levels = place_levels(self.initial_output, settings.half_swing, settings.ratio, settings.relay_limits)
        self._started_s = sample.t
        if levels is None or not low <= self.initial_output <= high:
            self.stop(refusals.output_outside(self.initial_output, low, high))
            return
        if self.settings.online is not None:
            if levels.one_sided:
                self.stop(refusals.no_room(self.initial_output, levels))
                return
            self._beside = Parallel(self.settings.online, self.initial_output, (low, high))
        self._levels = levels
        self._stage = Rest(settings, self.initial_output, levels)
        self.phase = next_phase(self.phase, PhaseEvent.ARMED)

    def _returning(self, stage: Stage, step: Step, sample: Sample) -> Step:
        """Return the step, or where the check of an integrating process ends, one that brings the PV back first."""
        process = self._integrating
        if step.event is not PhaseEvent.CHECKED or not isinstance(stage, HalfRelay | Holds):
            return step
        if process is None or (process.K > 0.0) != self.settings.direct:
            return step
        moved, averaged_s = self._displacement, RETURN_MEAN * stage.found.cycle.period_s
        loaded = moved.shows_load(process, averaged_s, stage.found.relay.amplitude)
        left = partial(moved.left, process, averaged_s) if loaded else lambda: moved.impulse
        following = Return(stage.found, left, self.initial_output, sample, self.settings.sample_time_s)
        return Step(following.output, following=following, segment="return", warning=step.warning)

    def _off_the_line(self, stage: Stage, step: Step) -> Step:
        """Return the step, or where the PV has left the line that was followed, one that rests again without it.

        Where the fixed reference fails too, the refusal is that of the line, with the drift as it was found.
        """
        if step.verdict is None or step.verdict.code not in LEFT_LINE:
            return step
        if self._line_verdict is not None:
            return replace(step, verdict=self._line_verdict)
        if self._baseline is None or self._levels is None or not isinstance(stage, Oscillation):
            return step
        self._baseline, self._line_verdict = None, step.verdict
        again = Rest(self.settings, self.initial_output, self._levels, left=stage)
        return Step(self.initial_output, PhaseEvent.LEFT_LINE, again, warning=LEFT_LINE_NOTE)

    def _over_time(self, sample: Sample) -> bool:
        return self._started_s is not None and sample.t - self._started_s > self.settings.time_limit_s

    def _advance(self, stage: Stage, sample: Sample) -> Command:
        levelled = sample if self._baseline is None else self._baseline.levelled(sample)
        self._displacement.step(levelled)
        step = stage.step(levelled)
        step = self._returning(stage, self._off_the_line(stage, step), levelled)
        self._baseline = step.baseline or self._baseline
        if self._baseline is not None and isinstance(stage, Oscillation):
            self._baseline.follow(sample, step.output)
        if step.segment is not None:
            self.segments[step.segment] = sample.t
        if isinstance(stage, Oscillation):
            self._relay_seen = stage.settings_so_far()
        self.warnings += [step.warning] if step.warning else []
        if step.verdict is not None:
            self.stop(step.verdict)
            return Command(self.initial_output, self.phase, step.estimate)
        self._stage = step.following or stage
        if step.event is not None:
            self.phase = next_phase(self.phase, step.event)
        if self.phase is Phase.RESTORE:
            return Command(self.initial_output, self.phase, step.estimate)
        output = step.output
        if self._beside is not None and not isinstance(self._stage, Return):
            output = self._beside.step(sample, output, resting=isinstance(stage, Rest))
        return Command(output, self.phase, step.estimate)
