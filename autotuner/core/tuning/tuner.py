"""From a process model to the gains that are recommended, with what every rule would have given.

Rules of this file:

1. Without a rule the gains come from the robust design; a goal is its limit of the sensitivities.
2. Every rule that can be applied stands beside them with its robustness and its error on the same model, so that a user
   sees what another choice would have cost.
3. The sample time's delay counts as dead time: half a sample for the hold.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.tuning.loop_grid import SHORTEST_SHARE, loop_grid, sum_of_lags
from autotuner.core.tuning.loop_margins import margins
from autotuner.core.tuning.requirements import Requirements, requirements_for
from autotuner.core.tuning.result import Candidate, Tuning
from autotuner.core.tuning.robust import design
from autotuner.core.tuning.rules import RuleResult, applicable, apply_rule
from autotuner.core.tuning.search import jitter_of
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.loop_grid import LoopGrid
    from autotuner.core.tuning.requirements import Noise
    from autotuner.core.tuning.ultimate import UltimatePoint
    from autotuner.core.tuning.uncertainty import Interval

ROBUST = "robust"
"""Name of the robust design where a rule's name stands."""
RISKY_MS = 2.0
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
) -> Tuning:
    """Return gains for a process, with their robustness and the alternatives.

    Parameters
    ----------
    model : ProcessModel or None
        The process; None is enough for a rule of the ultimate point.
    goal : str or Requirements
        ``calm``, ``balanced``, ``brisk``, or the requirements in numbers; not looked at when a rule is given.
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
    sample_time_s : float
        Of the controller, s.
    noise : Noise, optional
        What was measured of it, to tell what it does to the output.

    Raises
    ------
    InputError
        Unknown goal or rule, nothing known of the process that the rule takes, no controller inside the limits, or a
        covariance or time that is none; names the field.
    """
    judged, notes = _judged(model, sample_time_s)
    bench = _Bench(judged, known_as)
    alternatives = tuple(bench.candidate(apply_rule(name, judged, ultimate)) for name in applicable(judged, ultimate))
    if rule is None:
        chosen, intervals = bench.designed(requirements_for(goal), covariance, tau_c_s)
    else:
        chosen, intervals = bench.candidate(apply_rule(rule, judged, ultimate, tau_c_s=tau_c_s)), {}
    return Tuning(
        goal=_named(goal) if rule is None else None,
        rule=chosen.rule,
        gains=chosen.gains,
        margins=chosen.margins,
        alternatives=alternatives,
        warnings=(*notes, *chosen.warnings, *_concerns(chosen)),
        iae=chosen.iae,
        overshoot=chosen.overshoot,
        intervals=intervals,
        jitter=bench.jitter(chosen, noise),
    )


def _named(goal: str | Requirements) -> str:
    return goal if isinstance(goal, str) else f"Ms {goal.Ms:g}"


def _judged(model: ProcessModel | None, sample_time_s: float) -> tuple[ProcessModel | None, tuple[str, ...]]:
    """Return the process that the controller sees: with the delay of its own sampling, and with some dead time."""
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
    """Where controllers are judged: the process on its grids, made once."""

    def __init__(self, model: ProcessModel | None, known_as: ProcessModel | None = None) -> None:
        self.model, self.known_as = model, known_as
        self.grid: LoopGrid | None = None if model is None else loop_grid(model)

    def candidate(self, result: RuleResult) -> Candidate:
        """Return a rule's gains with what they do on the model."""
        plain = Candidate(result.rule, result.title, result.source, result.gains, None, warnings=result.warnings)
        if self.grid is None:
            return plain
        found = margins(self.grid.model, result.gains)
        if not found.stable or result.gains.Ki == 0.0:
            return replace(plain, margins=found)
        iae = max(self.grid.integral_of(self.grid.load_error(result.gains)), 1.0 / abs(result.gains.Ki))
        return replace(plain, margins=found, iae=iae, overshoot=self.grid.overshoot(result.gains))

    def jitter(self, chosen: Candidate, noise: Noise | None) -> float | None:
        """Return what the noise does to the output; None where it is not known, or the loop is not stable."""
        if self.grid is None or noise is None or chosen.margins is None or not chosen.margins.stable:
            return None
        return jitter_of(self.grid, chosen.gains, noise)

    def designed(
        self, requirements: Requirements, covariance: FloatArray | None, tau_c_s: float | None
    ) -> tuple[Candidate, dict[str, Interval]]:
        """Return the robust design, or the timed rule where that is asked and robust enough."""
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
        known = self.model if self.known_as is None else replace(self.known_as, D=self.model.D)  # type: ignore[type-var]
        found = design(known, requirements, covariance)
        finite_iae = found.iae if math.isfinite(found.iae) else None
        title = f"Smallest error within Ms {found.requirements.Ms:g}, Mt {found.requirements.Mt:g}"
        source = "Garpinger and Hagglund, J. Process Control 24, 2014"
        warnings = (*notes, *found.warnings)
        chosen = Candidate(ROBUST, title, source, found.gains, found.margins, finite_iae, found.overshoot, warnings)
        return chosen, found.intervals


def _concerns(chosen: Candidate) -> tuple[str, ...]:
    """Return what the robustness of the chosen gains has to warn of."""
    if chosen.margins is None:
        return ("no model is known, so the robustness of these gains was not checked",)
    if not chosen.margins.stable:
        return ("the closed loop is unstable on the model: do not use these gains",)
    if chosen.margins.Ms is not None and chosen.margins.Ms > RISKY_MS:
        return (f"Ms is {chosen.margins.Ms:.2f}: above {RISKY_MS:g} a loop oscillates and is easily made unstable",)
    return ()
