"""Design of the recommended gains from a process model, with the gains of every rule.

Invariants:

1. Without a rule the gains come from the robust design; a goal is its limit of the sensitivities.
2. Every applicable rule is listed as well, with its robustness and its error on the same model, for comparison.
3. The sample time's delay counts as dead time: half a sample for the hold.

Result of a design: the recommended gains, and the alternatives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from autotuner.core.design.loop_margins import margins
from autotuner.core.design.optimisation.loop_grid import SHORTEST_SHARE, loop_grid
from autotuner.core.design.optimisation.robust import design
from autotuner.core.design.optimisation.search import jitter_of
from autotuner.core.design.optimisation.uncertainty import checked_covariance, worst_models
from autotuner.core.design.requirements import Requirements, requirements_for
from autotuner.core.design.rules.tuning_rules import RuleResult, applicable, apply_rule
from autotuner.core.model.process import sum_of_lags
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.controller_advice import ControllerAdvice
    from autotuner.core.design.device_controller import DeviceController
    from autotuner.core.design.forms.held_gains import HeldGains
    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.loop_margins import Margins
    from autotuner.core.design.optimisation.loop_grid import LoopGrid
    from autotuner.core.design.optimisation.uncertainty import Interval
    from autotuner.core.design.requirements import Noise
    from autotuner.core.design.rules.ultimate import UltimatePoint
    from autotuner.core.design.simulation.closed_loop_setup import LoopPrediction
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

ROBUST = "robust"
"""Name of the robust design among the rules' names."""
RISKY_MS = 2.0
"""Largest sensitivity without a warning; 1.2 to 2.0 are the usual range (Astrom and Hagglund, 2006, section 4.6)."""
TIMED_RULE = "simc_pid"
"""The rule for a wanted closed-loop time."""


def tune(
    model: ProcessModel | None,
    goal: str | Requirements = "balanced",
    rule: str | None = None,
    ultimate: UltimatePoint | None = None,
    *,
    tau_c_s: float | None = None,
    covariance: FloatArray | None = None,
    known_as: ProcessModel | None = None,
    sample_time_s: float = 0.0,
    noise: Noise | None = None,
    device: DeviceController | None = None,
    compared: bool = True,
) -> PidDesign:
    """Return gains for a process, with their robustness and the alternatives.

    Parameters
    ----------
    model : ProcessModel or None
        The process; None is enough for a rule of the ultimate point.
    goal : str or Requirements
        ``calm``, ``balanced``, ``brisk``, or the requirements in numbers; ignored when a rule is given.
    rule : str, optional
        A tuning rule by name, one of `rule_names`, instead of the robust design.
    ultimate : UltimatePoint, optional
        The measured ultimate point, for the rules that take it.
    tau_c_s : float, optional
        Wanted closed-loop time constant, s: for the rule that is named, else by SIMC within the goal's sensitivity.
    covariance : array of float, shape (p, p), optional
        Covariance of the model's parameters: the limits then hold over its 95 % region, and gains have intervals.
    known_as : ProcessModel, optional
        The process by the parameters that the covariance is of, where those are others.
    sample_time_s, noise : float, Noise, optional
        Sample time of the controller, s; measured noise, for the output movement that it causes.
    device : DeviceController, optional
        The controller that will hold the gains: rules are judged as it runs them, for a goal it is designed with.
    compared : bool
        Whether the alternatives are made, by every rule.

    Raises
    ------
    InputError
        Unknown goal or rule, no process for the rule, no controller inside the limits, bad covariance or time.
    """
    judged, notes = judged_process(model, sample_time_s)
    bench = _Bench(judged, known_as, noise, device)
    alternatives = tuple(bench.candidate(result) for result in (_by_rules(judged, ultimate) if compared else ()))
    ruled = None if rule is None else bench.candidate(apply_rule(rule, judged, ultimate, tau_c_s=tau_c_s))
    chosen, intervals = (ruled, {}) if ruled else bench.designed(requirements_for(goal), covariance, tau_c_s)
    warnings = (*notes, *bench.concerns_over_region(chosen, covariance), *chosen.warnings, *_concerns(chosen))
    named = _named(goal) if rule is None else None
    found = PidDesign(named, chosen.rule, chosen.gains, chosen.margins, alternatives, warnings)
    return replace(found, iae=chosen.iae, overshoot=chosen.overshoot, intervals=intervals, jitter=chosen.jitter)


def _by_rules(judged: ProcessModel | None, ultimate: UltimatePoint | None) -> list[RuleResult]:
    return [apply_rule(name, judged, ultimate) for name in applicable(judged, ultimate)]


def _named(goal: str | Requirements) -> str:
    return goal if isinstance(goal, str) else f"Ms {goal.Ms:g}"


def judged_process(model: ProcessModel | None, sample_time_s: float) -> tuple[ProcessModel | None, tuple[str, ...]]:
    """Return the process that the controller sees: with the delay of its sampling, and with a minimal dead time."""
    if not 0.0 <= sample_time_s < math.inf:
        raise InputError("must not be negative", field="sample_time_s", value=sample_time_s, remedy="Give seconds.")
    if model is None:
        return None, ()
    D = model.D + sample_time_s / 2.0
    least = SHORTEST_SHARE * sum_of_lags(model)
    if least < D:
        return replace(model, D=D), ()  # type: ignore[type-var]
    assumed = 100.0 * least or 1.0
    note = (
        f"the model has no dead time to speak of, but every loop has; {assumed:.3g} s was taken (give the sample time)"
    )
    return replace(model, D=assumed), (note,)  # type: ignore[type-var]


class _Bench:
    """Evaluation of controllers: the process on its grids, computed once."""

    def __init__(
        self,
        model: ProcessModel | None,
        known_as: ProcessModel | None,
        noise: Noise | None,
        device: DeviceController | None,
    ) -> None:
        self.model, self.known_as, self.noise, self.device = model, known_as, noise, device
        self.grid: LoopGrid | None = None if model is None else loop_grid(model)

    def candidate(self, result: RuleResult) -> Candidate:
        """Return a rule's gains with their results on the model."""
        gains = result.gains if self.device is None else self.device.as_run(result.gains)
        unjudged = Candidate(result.rule, result.title, result.source, gains, None, warnings=result.warnings)
        if self.grid is None:
            return unjudged
        found = margins(self.grid.model, gains)
        judged = replace(unjudged, margins=found, jitter=self.jitter(gains, found))
        if not found.stable or gains.Ki == 0.0:
            return judged
        iae = max(self.grid.integral_of(self.grid.load_error(gains)), 1.0 / abs(gains.Ki))
        return replace(judged, iae=iae, overshoot=self.grid.overshoot(gains))

    def jitter(self, gains: PidGains, found: Margins) -> float | None:
        """Return the standard deviation of the output by noise; None without known noise, or for an unstable loop."""
        if self.grid is None or self.noise is None or not found.stable:
            return None
        return jitter_of(self.grid, gains, self.noise)

    def _known(self, model: ProcessModel) -> ProcessModel:
        """Return the process by the parameters that the covariance is of."""
        return model if self.known_as is None else replace(self.known_as, D=model.D)  # type: ignore[type-var]

    def concerns_over_region(self, chosen: Candidate, covariance: FloatArray | None) -> tuple[str, ...]:
        """Return a warning where a rule's gains are robust on the model alone: a rule does not allow for its errors."""
        if self.grid is None or covariance is None or chosen.rule == ROBUST or _concerns(chosen):
            return ()
        known, limits = self._known(self.grid.model), Requirements(Ms=RISKY_MS, Mt=RISKY_MS)
        region = worst_models(known, chosen.gains, checked_covariance(known, covariance), self.grid.w, limits)
        worst = max((margins(model, chosen.gains).Ms or math.inf for model in region), default=1.0)
        if worst <= RISKY_MS:
            return ()
        loop = f"Ms is up to {worst:.2f}" if worst < math.inf else "the loop is unstable in part"
        text = (
            f"the record leaves the process uncertain, which a rule does not allow for: over its 95 % region {loop}; "
            "take the robust design, or repeat the test with the check, longer or at a larger amplitude"
        )
        return (text,)

    def designed(
        self, requirements: Requirements, covariance: FloatArray | None, tau_c_s: float | None
    ) -> tuple[Candidate, dict[str, Interval]]:
        """Return the robust design, or the timed rule where it is requested and robust enough."""
        if self.model is None:
            raise InputError("is needed for a goal", field="model", remedy="Give a process model, or name a rule.")
        notes: tuple[str, ...] = ()
        if tau_c_s is not None:
            timed = self.candidate(apply_rule(TIMED_RULE, self.model, tau_c_s=tau_c_s))
            if timed.margins and timed.margins.Ms is not None and timed.margins.Ms <= requirements.Ms:
                return timed, {}
            notes = (
                f"a closed loop of {tau_c_s:g} s needs more than Ms {requirements.Ms:g}; the robust design is given",
            )
        found = design(self._known(self.model), requirements, covariance)
        finite_iae = found.iae if math.isfinite(found.iae) else None
        title = f"Smallest error within Ms {found.requirements.Ms:g}, Mt {found.requirements.Mt:g}"
        source = "Garpinger and Hagglund, J. Process Control 24, 2014"
        warnings = (*notes, *found.warnings)
        jitter = self.jitter(found.gains, found.margins)
        chosen = Candidate(
            ROBUST, title, source, found.gains, found.margins, finite_iae, found.overshoot, warnings, jitter=jitter
        )
        return chosen, found.intervals


def _concerns(chosen: Candidate) -> tuple[str, ...]:
    """Return warnings about the robustness of the chosen gains."""
    if chosen.margins is None:
        return ("no model is known, so the robustness of these gains was not checked",)
    if not chosen.margins.stable:
        return ("the closed loop is unstable on the model: do not use these gains",)
    if chosen.margins.Ms is not None and chosen.margins.Ms > RISKY_MS:
        return (f"Ms is {chosen.margins.Ms:.2f}: above {RISKY_MS:g} a loop oscillates and is easily made unstable",)
    return ()


@dataclass(frozen=True, slots=True)
class Candidate:
    """One controller with its results on the model; robustness and errors are None without a model.

    Attributes
    ----------
    rule, title, source : str
        Origin of the gains.
    gains : PidGains
        The controller.
    margins : Margins or None
        Its robustness.
    iae : float or None
        Integral of the absolute error after a unit load step, PV s/output; None also without integral action.
    overshoot : float or None
        Largest excess of the PV over a set-point step, share of the step.
    warnings : tuple of str
        Warnings of the rule.
    settling_time_s : float or None
        Time from which the PV stays within 2 % of a set-point step, s; None where it is not predicted.
    jitter : float or None
        Standard deviation of the output by the measured noise, output units; None without known noise.
    """

    rule: str
    title: str
    source: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = None
    overshoot: float | None = None
    warnings: tuple[str, ...] = ()
    settling_time_s: float | None = None
    jitter: float | None = None

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "rule": self.rule,
            "title": self.title,
            "source": self.source,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "iae": self.iae,
            "overshoot": self.overshoot,
            "settling_time_s": self.settling_time_s,
            "jitter": self.jitter,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True, repr=False)
class PidDesign:
    """Gains recommended for a process, and the alternatives.

    Attributes
    ----------
    goal : str or None
        The requested goal; None for a rule.
    rule : str
        ``robust``, or the rule that gave the gains.
    gains : PidGains
        The recommended controller.
    margins : Margins or None
        Its robustness on the model; None without a model.
    iae, overshoot : float or None
        As in `Candidate`.
    intervals : dict of str to Interval
        95 % intervals of the gains; empty without a covariance of the model.
    jitter : float or None
        Standard deviation of the output by the measured noise, output units; None without known noise.
    jitter_limit : float or None
        Limit of it, output units; None where nothing limits it.
    alternatives : tuple of Candidate
        Every rule that can be applied, in the order of the table.
    warnings : tuple of str
        What the user must know before using the gains.
    held : HeldGains or None
        Gains as held by the device; None without a known device, or when it cannot hold them.
    predicted : LoopPrediction or None
        What the loop will do with the controller that holds the gains; None before `with_prediction`, and for a loop
        that is unstable on the model.
    advice : ControllerAdvice or None
        Which parts of a controller the process needs; None before `with_prediction`, and where it cannot be compared.
    """

    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    alternatives: tuple[Candidate, ...]
    warnings: tuple[str, ...]
    iae: float | None = None
    overshoot: float | None = None
    intervals: dict[str, Interval] = field(default_factory=dict)
    jitter: float | None = None
    jitter_limit: float | None = None
    held: HeldGains | None = None
    predicted: LoopPrediction | None = None
    advice: ControllerAdvice | None = None

    def __repr__(self) -> str:
        gains = self.held.gains if self.held else self.gains
        return f"<PidDesign {self.goal or self.rule}: {gains.words}>"

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "goal": self.goal,
            "rule": self.rule,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "iae": self.iae,
            "overshoot": self.overshoot,
            "intervals": {name: [interval.low, interval.high] for name, interval in self.intervals.items()},
            "jitter": self.jitter,
            "jitter_limit": self.jitter_limit,
            "device": self.held.to_dict() if self.held else None,
            "predicted": self.predicted.to_dict() if self.predicted else None,
            "advice": self.advice.to_dict() if self.advice else None,
            "alternatives": [candidate.to_dict() for candidate in self.alternatives],
            "warnings": list(self.warnings),
        }
