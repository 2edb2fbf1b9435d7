"""From a process model to the gains that are recommended, with what every rule would have given.

Rules of this file: a goal is a limit of the sensitivity; among the controllers within it the one with the largest
integral gain is taken, because the integrated error after a load step is `Ti/Kp` for any stable loop with integral
action (Astrom and Hagglund, Advanced PID Control, 2006, eq. 4.34).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.tuning.margins import Margins, margins
from autotuner.core.tuning.rules import RuleResult, applicable, apply_rule
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.gains import PidGains
    from autotuner.core.tuning.ultimate import UltimatePoint

GOALS: dict[str, float] = {"calm": 1.25, "balanced": 1.4, "brisk": 1.7}
"""Largest sensitivity `Ms` by goal."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One rule's gains with the robustness they give on the model (None when only the ultimate point is known)."""

    rule: str
    title: str
    source: str
    gains: PidGains
    margins: Margins | None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "rule": self.rule,
            "title": self.title,
            "source": self.source,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True)
class Tuning:
    """The gains recommended for a process, and what they were chosen from.

    Attributes
    ----------
    goal : str or None
        Goal that was asked; None when a rule was.
    rule : str
        Rule that gave the gains.
    gains : PidGains
        The recommended controller.
    margins : Margins or None
        Its robustness on the model; None without a model.
    alternatives : tuple of Candidate
        Every rule that can be applied, in the order of the table.
    warnings : tuple of str
        What the user must know before using the gains.
    """

    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    alternatives: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "goal": self.goal,
            "rule": self.rule,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "alternatives": [candidate.to_dict() for candidate in self.alternatives],
            "warnings": list(self.warnings),
        }


def tune(
    model: ProcessModel | None,
    goal: str = "balanced",
    rule: str | None = None,
    ultimate: UltimatePoint | None = None,
    *,
    tau_c_s: float | None = None,
) -> Tuning:
    """Return gains for a process, with their robustness and the alternatives.

    Parameters
    ----------
    model : ProcessModel or None
        The process; None is enough for a rule of the ultimate point.
    goal : str
        ``calm``, ``balanced`` or ``brisk``; not looked at when a rule is given.
    rule : str, optional
        A tuning rule by name, one of `autotuner.core.tuning.rule_names`.
    ultimate : UltimatePoint, optional
        The measured ultimate point, for the rules that take it.
    tau_c_s : float, optional
        Wanted closed-loop time constant, s, for rules that have this choice.

    Raises
    ------
    InputError
        Unknown goal or rule, or nothing known of the process that the rule takes.
    """
    alternatives = tuple(_candidate(apply_rule(name, model, ultimate), model) for name in applicable(model, ultimate))
    if rule is not None:
        chosen, goal_asked = _candidate(apply_rule(rule, model, ultimate, tau_c_s=tau_c_s), model), None
    else:
        chosen, goal_asked = _within(goal, alternatives, model), goal
    return Tuning(
        goal_asked, chosen.rule, chosen.gains, chosen.margins, alternatives, (*chosen.warnings, *_concerns(chosen))
    )


def _candidate(result: RuleResult, model: ProcessModel | None) -> Candidate:
    robustness = None if model is None else margins(model, result.gains)
    return Candidate(result.rule, result.title, result.source, result.gains, robustness, result.warnings)


def _within(goal: str, candidates: tuple[Candidate, ...], model: ProcessModel | None) -> Candidate:
    """Return the candidate with the largest integral gain inside the goal's sensitivity, or the most robust one."""
    if goal not in GOALS:
        raise InputError("is not a known goal", field="goal", value=goal, remedy=f"Use one of {', '.join(GOALS)}.")
    if model is None:
        raise InputError("is needed for a goal", field="model", remedy="Give a process model, or name a rule.")
    robust = [(c, c.margins.Ms) for c in candidates if c.margins and c.margins.Ms is not None and c.gains.Ki != 0.0]
    if not robust:
        raise InputError(
            "has no stabilising rule", field="model", value=model, remedy="Check the model's dead time and structure."
        )
    inside = [c for c, Ms in robust if Ms <= GOALS[goal]]
    return max(inside, key=lambda c: abs(c.gains.Ki)) if inside else min(robust, key=lambda pair: pair[1])[0]


def _concerns(chosen: Candidate) -> tuple[str, ...]:
    """Return what the robustness of the chosen gains has to warn of."""
    if chosen.margins is None:
        return ("no model is known, so the robustness of these gains was not checked",)
    if not chosen.margins.stable:
        return ("the closed loop is unstable on the model: do not use these gains",)
    if chosen.margins.Ms is not None and chosen.margins.Ms > 2.0:
        return (f"Ms is {chosen.margins.Ms:.2f}: above 2 a loop oscillates and is easily made unstable",)
    return ()
