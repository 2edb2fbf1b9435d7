"""Application of a row of the table of rules to the known properties of a process.

Invariants:

1. A rule gets the process that its source treats. A model of another structure is reduced where a sound reduction is
   known, and the result states that; else the rule is refused with the structures it takes.
2. A rule of the ultimate point takes the measured one, or the exact one of the model.
3. Rules choose no measurement filter. A derivative needs one: `Tf = Td/10` (Astrom and Hagglund, Advanced PID Control,
   2006, section 3.4, with N = 10); without derivative `Tf` is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.design.rules.reduction import reduce_to
from autotuner.core.design.rules.rule_table import RULES, rule_named
from autotuner.core.design.rules.ultimate import UltimatePoint, ultimate_point
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.rules.rule_table import Rule
    from autotuner.core.model.process import ProcessModel

FILTER_RATIO = 10.0
"""`Td / Tf` of the filter that is added to a rule with derivative action."""


@dataclass(frozen=True, slots=True)
class RuleResult:
    """Result of a rule.

    Attributes
    ----------
    rule, title, source : str
        Identifier of the rule, its display name, and the source of its formula.
    gains : PidGains
        The controller.
    warnings : tuple of str
        Reductions made and limits of validity exceeded.
    """

    rule: str
    title: str
    source: str
    gains: PidGains
    warnings: tuple[str, ...]


def apply_rule(
    name: str,
    model: ProcessModel | None = None,
    ultimate: UltimatePoint | None = None,
    *,
    tau_c_s: float | None = None,
) -> RuleResult:
    """Return the gains that a rule gives for a process.

    Parameters
    ----------
    name : str
        Name of the rule, one of `rule_names`.
    model : ProcessModel, optional
        The process; rules of the ultimate point do without.
    ultimate : UltimatePoint, optional
        The measured ultimate point; from the model's exact frequency response when left out.
    tau_c_s : float, optional
        Wanted closed-loop time constant, s, for the rules that have this choice; else the rule's own default.

    Raises
    ------
    InputError
        Unknown rule, nothing given that the rule takes, a model without dead time where the rule divides by it, or a
        `tau_c_s` that is not positive or not an option of the rule.
    """
    rule = rule_named(name)
    _check_tau_c(rule, tau_c_s)
    process, notes = _process_for(rule, model, ultimate)
    gains = _gains(rule, process, tau_c_s)
    if gains.Td > 0.0:
        gains = replace(gains, Tf=gains.Td / FILTER_RATIO)
    return RuleResult(rule.name, rule.title, rule.source, gains, (*notes, *_outside(rule, process, model, tau_c_s)))


def applicable(model: ProcessModel | None, ultimate: UltimatePoint | None = None) -> tuple[str, ...]:
    """Return the names of the rules that are applicable with their defaults."""
    names = []
    for name in RULES:
        try:
            apply_rule(name, model, ultimate)
        except InputError:
            continue
        names.append(name)
    return tuple(names)


def _check_tau_c(rule: Rule, tau_c_s: float | None) -> None:
    if tau_c_s is None:
        return
    if not rule.takes_tau_c:
        takers = ", ".join(row.name for row in RULES.values() if row.takes_tau_c)
        raise InputError(
            f"is not an option of {rule.title}",
            field="tau_c_s",
            value=tau_c_s,
            remedy=f"Leave it out, or use {takers}.",
        )
    if not 0.0 < tau_c_s < math.inf:
        raise InputError("must be a positive time", field="tau_c_s", value=tau_c_s, remedy="Give seconds above 0.")


def _process_for(
    rule: Rule, model: ProcessModel | None, ultimate: UltimatePoint | None
) -> tuple[UltimatePoint | ProcessModel, tuple[str, ...]]:
    """Return the process to which the rule is applied, and notes on its derivation."""
    if UltimatePoint in rule.formulas:
        return _ultimate_for(rule, model, ultimate), ()
    if model is None:
        raise InputError(
            f"is needed: {rule.title} takes {_takes(rule)}",
            field="model",
            remedy="Give a process model, or another rule.",
        )
    for kind in rule.formulas:
        reduced, derivation = reduce_to(kind, model)
        if reduced is not None:
            return reduced, (
                f"{rule.title} takes {_TAKES[kind]}; the model was reduced by {derivation}",
            ) if derivation else ()
    raise InputError(
        f"is of a structure that {rule.title} does not treat",
        field="model.structure",
        value=model.structure,
        remedy=f"The rule takes {_takes(rule)}; use a rule of the ultimate point, or a goal instead of a rule.",
    )


def _ultimate_for(rule: Rule, model: ProcessModel | None, ultimate: UltimatePoint | None) -> UltimatePoint:
    if ultimate is not None:
        return ultimate
    if model is None:
        raise InputError(
            f"is needed: {rule.title} takes the ultimate point",
            field="ultimate",
            remedy="Give Ku and Pu of a relay test, or a model.",
        )
    point = ultimate_point(model)
    if point is None:
        raise InputError(
            "has no ultimate point: its phase never crosses -180 degrees",
            field="model.D",
            value=model.D,
            remedy="Give the dead time of the loop, or use a rule for models such as lambda_pi with tau_c_s.",
        )
    return point


def _gains(rule: Rule, process: UltimatePoint | ProcessModel, tau_c_s: float | None) -> PidGains:
    options = (tau_c_s,) if rule.takes_tau_c else ()
    for kind, formula in rule.formulas.items():
        if isinstance(process, kind):
            try:
                return formula(process, *options)
            except (ZeroDivisionError, OverflowError, InputError) as error:
                raise InputError(
                    f"is zero or tiny, which gives {rule.title} an infinite gain",
                    field="model.D",
                    value=getattr(process, "D", None),
                    remedy="Give the dead time of the loop (half a sample time at least), or tau_c_s.",
                ) from error
    raise AssertionError(rule)


def _outside(
    rule: Rule, process: UltimatePoint | ProcessModel, model: ProcessModel | None, tau_c_s: float | None
) -> tuple[str, ...]:
    """Return a warning when the process lies outside the rule's valid range."""
    limits = rule.valid
    value = None if limits is None else _QUANTITIES[limits.quantity](process, model, tau_c_s)
    if limits is None or value is None or limits.lower <= value <= limits.upper:
        return ()
    upper = f"to {limits.upper:g}" if math.isfinite(limits.upper) else "upwards"
    span = f"{limits.lower:g} {upper}"
    return (f"{limits.quantity} is {value:.3g}, outside the range of {rule.title}, {span}: {limits.outside}",)


def _dead_time_ratio(process: object, _: object, __: float | None) -> float | None:
    return process.D / process.T if isinstance(process, Fopdt) else None


def _gain_ratio(process: object, model: object, _: float | None) -> float | None:
    stable = model is not None and not isinstance(model, Integrating)
    return model.K * process.Ku if stable and isinstance(process, UltimatePoint) else None  # type: ignore[attr-defined]


def _tau_c_ratio(process: object, _: object, tau_c_s: float | None) -> float | None:
    D = getattr(process, "D", 0.0)
    return None if tau_c_s is None or D == 0.0 else tau_c_s / D


_QUANTITIES = {"D/T": _dead_time_ratio, "K Ku": _gain_ratio, "tau_c/D": _tau_c_ratio}

_TAKES: dict[type, str] = {
    UltimatePoint: "the ultimate point",
    Fopdt: "a FOPDT model",
    SopdtOverdamped: "an overdamped SOPDT model",
    Integrating: "an integrating model",
}


def _takes(rule: Rule) -> str:
    return " or ".join(_TAKES[kind] for kind in rule.formulas)
