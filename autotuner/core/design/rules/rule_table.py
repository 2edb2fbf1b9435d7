"""Tuning rules as rows: formula, source, required inputs, range of validity.

Symbols as in `autotuner.core.model.process`; `a = K D/T` is the normalised gain of a FOPDT process
(for an integrator `K D`), `Ku`, `Pu` the ultimate point,
`tau_c` the closed-loop time constant wanted (s), `Kp`, `Ti`, `Td` of the ideal form.

Invariants:

1. A row is as in its source, for the process that the source treats. Reductions of other processes happen
   before (`autotuner.core.design.rules.reduction`).
2. Limits of validity come from the source or from the work cited in the row; outside of them a rule warns.
3. Where the source treats `K e^{-Ds}/s`, the lag of an integrator is added to its dead time: the asymptote of its ramp.
4. No rule chooses the measurement filter; `autotuner.core.design.rules.tuning_rules` adds it.

The rows of the table of rules by their names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from autotuner.core.design.gains import PidGains
from autotuner.core.design.rules.ultimate import UltimatePoint
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped
from autotuner.errors import InputError

Formula = Callable[..., PidGains]
"""Function from the process (and `tau_c` for rules that have it) to the gains."""


@dataclass(frozen=True, slots=True)
class Range:
    """Range of validity of a rule: `lower <= quantity <= upper`, and the consequence outside."""

    quantity: str
    lower: float
    upper: float
    outside: str


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table.

    Attributes
    ----------
    name, title, source : str
        Identifier, display name, and source of the formula.
    controller : str
        ``P``, ``PI`` or ``PID``.
    formulas : dict of type to formula
        The formula for each process that the source treats: `UltimatePoint`, `Fopdt`, `SopdtOverdamped`, `Integrating`.
    valid : Range or None
        Where the source, or later work on it, found the rule good.
    takes_tau_c : bool
        Whether the wanted closed-loop time constant is an option of the rule.
    """

    name: str
    title: str
    controller: str
    formulas: dict[type, Formula]
    source: str
    valid: Range | None = None
    takes_tau_c: bool = False


def _ultimate(gain: float, Ti: float | None = None, Td: float = 0.0) -> dict[type, Formula]:
    """Return the formulas of a rule `Kp = gain Ku`, `Ti` and `Td` in ultimate periods."""

    def formula(u: UltimatePoint) -> PidGains:
        return PidGains(gain * u.Ku, **_times(Ti, Td, u.Pu))

    return {UltimatePoint: formula}


def _reaction(gain: float, Ti: float | None = None, Td: float = 0.0, *, Ti_unit: str = "D") -> dict[type, Formula]:
    """Return the formulas of a rule `Kp = gain/a`, `Td` in dead times, `Ti` in dead times or time constants."""

    def fopdt(m: Fopdt) -> PidGains:
        unit = m.T if Ti_unit == "T" else m.D
        return PidGains(gain * m.T / (m.K * m.D), **_times(Ti, Td, unit, m.D))

    def integrating(m: Integrating) -> PidGains:
        return PidGains(gain / (m.K * (m.D + m.T)), **_times(Ti, Td, m.D + m.T))

    return {Fopdt: fopdt} if Ti_unit == "T" else {Fopdt: fopdt, Integrating: integrating}


def _times(Ti: float | None, Td: float, unit: float, Td_unit: float | None = None) -> dict[str, float]:
    integral = {} if Ti is None else {"Ti": Ti * unit}
    return {**integral, "Td": Td * (unit if Td_unit is None else Td_unit)}


def _cohen_coon_p(m: Fopdt) -> PidGains:
    r = m.D / m.T
    return PidGains((1.0 + r / 3.0) / (m.K * r))


def _cohen_coon_pi(m: Fopdt) -> PidGains:
    r = m.D / m.T
    return PidGains((0.9 + r / 12.0) / (m.K * r), m.D * (30.0 + 3.0 * r) / (9.0 + 20.0 * r))


def _cohen_coon_pid(m: Fopdt) -> PidGains:
    r = m.D / m.T
    Ti = m.D * (32.0 + 6.0 * r) / (13.0 + 8.0 * r)
    return PidGains((4.0 / 3.0 + r / 4.0) / (m.K * r), Ti, 4.0 * m.D / (11.0 + 2.0 * r))


def _simc_pi(m: Fopdt, tau_c: float | None) -> PidGains:
    closed = (m.D if tau_c is None else tau_c) + m.D
    return PidGains(m.T / (m.K * closed), min(m.T, 4.0 * closed))


def _simc_pi_integrating(m: Integrating, tau_c: float | None) -> PidGains:
    D = m.D + m.T
    closed = (D if tau_c is None else tau_c) + D
    return PidGains(1.0 / (m.K * closed), 4.0 * closed)


def _simc_pid(m: SopdtOverdamped, tau_c: float | None) -> PidGains:
    closed = (m.D if tau_c is None else tau_c) + m.D
    return _from_series(m.T1 / (m.K * closed), min(m.T1, 4.0 * closed), m.T2)


def _simc_pid_integrating(m: Integrating, tau_c: float | None) -> PidGains:
    closed = (m.D if tau_c is None else tau_c) + m.D
    return _from_series(1.0 / (m.K * closed), 4.0 * closed, m.T)


def _from_series(Kc: float, Ti: float, Td: float) -> PidGains:
    interaction = 1.0 + Td / Ti
    return PidGains(Kc * interaction, Ti + Td, Td / interaction)


def _lambda_pi(m: Fopdt, tau_c: float | None) -> PidGains:
    closed = max(m.T, m.D) if tau_c is None else tau_c
    return PidGains(m.T / (m.K * (closed + m.D)), m.T)


def _lambda_pi_integrating(m: Integrating, tau_c: float | None) -> PidGains:
    D = m.D + m.T
    closed = 3.0 * D if tau_c is None else tau_c
    return PidGains((2.0 * closed + D) / (m.K * (closed + D) ** 2), 2.0 * closed + D)


def _lambda_pid(m: Fopdt, tau_c: float | None) -> PidGains:
    closed = max(m.T, m.D) if tau_c is None else tau_c
    Ti = m.T + m.D / 2.0
    return PidGains(Ti / (m.K * (closed + m.D / 2.0)), Ti, m.T * m.D / (2.0 * m.T + m.D))


def _amigo_pi(m: Fopdt) -> PidGains:
    Kp = 0.15 / m.K + (0.35 - m.D * m.T / (m.D + m.T) ** 2) * m.T / (m.K * m.D)
    Ti = 0.35 * m.D + 13.0 * m.D * m.T**2 / (m.T**2 + 12.0 * m.D * m.T + 7.0 * m.D**2)
    return PidGains(Kp, Ti, b=_amigo_weight(m))


def _amigo_pid(m: Fopdt) -> PidGains:
    Ti = m.D * (0.4 * m.D + 0.8 * m.T) / (m.D + 0.1 * m.T)
    Td = 0.5 * m.D * m.T / (0.3 * m.D + m.T)
    return PidGains((0.2 + 0.45 * m.T / m.D) / m.K, Ti, Td, b=_amigo_weight(m))


def _amigo_weight(m: Fopdt) -> float:
    return 0.0 if m.D <= m.T else 1.0


def _amigo_pi_integrating(m: Integrating) -> PidGains:
    D = m.D + m.T
    return PidGains(0.35 / (m.K * D), 13.4 * D, b=0.0)


def _amigo_pid_integrating(m: Integrating) -> PidGains:
    D = m.D + m.T
    return PidGains(0.45 / (m.K * D), 8.0 * D, 0.5 * D, b=0.0)


_ZN = "Ziegler and Nichols, Trans. ASME 64, 1942"
_TL = "Tyreus and Luyben, Ind. Eng. Chem. Res. 31, 1992"
_CC = "Cohen and Coon, Trans. ASME 75, 1953"
_CHR = "Chien, Hrones and Reswick, Trans. ASME 74, 1952"
_SIMC = "Skogestad, J. Process Control 13, 2003, eqs. 23-25"
_IMC = "Rivera, Morari and Skogestad, Ind. Eng. Chem. Process Des. Dev. 25, 1986, table 1"
_LAMBDA = (
    "Dahlin, Instruments and Control Systems 41, 1968; for integrators Chien and Fruehauf, Chem. Eng. Prog. 86, 1990"
)
_AMIGO = "Astrom and Hagglund, J. Process Control 14, 2004"
_HANG = "Hang, Astrom and Ho, IEE Proc. D 138, 1991"

_ZN_ULTIMATE_RANGE = Range("K Ku", 2.25, 15.0, f"the loop may be poorly damped ({_HANG})")
_ZN_REACTION_RANGE = Range("D/T", 0.15, 0.6, f"the loop may be poorly damped ({_HANG})")
_LAG_RANGE = Range("D/T", 0.1, 1.0, "the rule was fitted inside this range")
_IMC_RANGE = Range("tau_c/D", 0.8, float("inf"), "the loop loses its robustness to an error of D (Rivera et al., 1986)")
_AMIGO_PID_RANGE = Range(
    "D/T", 1.0, float("inf"), "the rule is calmer than it need be for a process dominated by its lag"
)

RULES: dict[str, Rule] = {
    rule.name: rule
    for rule in (
        Rule("ziegler_nichols_p", "Ziegler-Nichols P, ultimate point", "P", _ultimate(0.5), _ZN),
        Rule(
            "ziegler_nichols_pi",
            "Ziegler-Nichols PI, ultimate point",
            "PI",
            _ultimate(0.45, 1.0 / 1.2),
            _ZN,
            _ZN_ULTIMATE_RANGE,
        ),
        Rule(
            "ziegler_nichols_pid",
            "Ziegler-Nichols PID, ultimate point",
            "PID",
            _ultimate(0.6, 0.5, 0.125),
            _ZN,
            _ZN_ULTIMATE_RANGE,
        ),
        Rule("ziegler_nichols_reaction_p", "Ziegler-Nichols P, reaction curve", "P", _reaction(1.0), _ZN),
        Rule(
            "ziegler_nichols_reaction_pi",
            "Ziegler-Nichols PI, reaction curve",
            "PI",
            _reaction(0.9, 1.0 / 0.3),
            _ZN,
            _ZN_REACTION_RANGE,
        ),
        Rule(
            "ziegler_nichols_reaction_pid",
            "Ziegler-Nichols PID, reaction curve",
            "PID",
            _reaction(1.2, 2.0, 0.5),
            _ZN,
            _ZN_REACTION_RANGE,
        ),
        Rule("tyreus_luyben_pi", "Tyreus-Luyben PI", "PI", _ultimate(1.0 / 3.2, 2.2), _TL),
        Rule(
            "tyreus_luyben_pid",
            "Tyreus-Luyben PID",
            "PID",
            _ultimate(1.0 / 2.2, 2.2, 1.0 / 6.3),
            f"{_TL}; Luyben and Luyben, Essentials of Process Control, 1997",
        ),
        Rule(
            "pessen_pid",
            "Pessen integral rule",
            "PID",
            _ultimate(0.7, 0.4, 0.15),
            "Pessen, J. Dyn. Sys. Meas. Control 116, 1994",
        ),
        Rule(
            "some_overshoot_pid",
            "Some overshoot",
            "PID",
            _ultimate(1.0 / 3.0, 0.5, 1.0 / 3.0),
            "Seborg, Edgar and Mellichamp, Process Dynamics and Control, 1989, table 13.3",
        ),
        Rule(
            "no_overshoot_pid",
            "No overshoot",
            "PID",
            _ultimate(0.2, 0.5, 1.0 / 3.0),
            "Seborg, Edgar and Mellichamp, Process Dynamics and Control, 1989, table 13.3",
        ),
        Rule("cohen_coon_p", "Cohen-Coon P", "P", {Fopdt: _cohen_coon_p}, _CC, _LAG_RANGE),
        Rule("cohen_coon_pi", "Cohen-Coon PI", "PI", {Fopdt: _cohen_coon_pi}, _CC, _LAG_RANGE),
        Rule("cohen_coon_pid", "Cohen-Coon PID", "PID", {Fopdt: _cohen_coon_pid}, _CC, _LAG_RANGE),
        *(
            Rule(
                f"chr_{response}_{overshoot}_{controller.lower()}",
                f"Chien-Hrones-Reswick {controller}, {response.replace('_', ' ')} response, {overshoot} % overshoot",
                controller,
                _reaction(gain, Ti, Td, Ti_unit="T" if response == "set_point" else "D"),
                _CHR,
                _LAG_RANGE,
            )
            for response, overshoot, controller, gain, Ti, Td in (
                ("load", 0, "P", 0.3, None, 0.0),
                ("load", 0, "PI", 0.6, 4.0, 0.0),
                ("load", 0, "PID", 0.95, 2.4, 0.42),
                ("load", 20, "P", 0.7, None, 0.0),
                ("load", 20, "PI", 0.7, 2.3, 0.0),
                ("load", 20, "PID", 1.2, 2.0, 0.42),
                ("set_point", 0, "P", 0.3, None, 0.0),
                ("set_point", 0, "PI", 0.35, 1.2, 0.0),
                ("set_point", 0, "PID", 0.6, 1.0, 0.5),
                ("set_point", 20, "P", 0.7, None, 0.0),
                ("set_point", 20, "PI", 0.6, 1.0, 0.0),
                ("set_point", 20, "PID", 0.95, 1.4, 0.47),
            )
        ),
        Rule(
            "simc_pi",
            "SIMC PI",
            "PI",
            {Fopdt: _simc_pi, Integrating: _simc_pi_integrating},
            _SIMC,
            takes_tau_c=True,
        ),
        Rule(
            "simc_pid",
            "SIMC PID",
            "PID",
            {SopdtOverdamped: _simc_pid, Integrating: _simc_pid_integrating},
            f"{_SIMC}, from its series form",
            takes_tau_c=True,
        ),
        Rule(
            "lambda_pi",
            "Lambda tuning, PI",
            "PI",
            {Fopdt: _lambda_pi, Integrating: _lambda_pi_integrating},
            _LAMBDA,
            _IMC_RANGE,
            takes_tau_c=True,
        ),
        Rule("lambda_pid", "Lambda (IMC) tuning, PID", "PID", {Fopdt: _lambda_pid}, _IMC, _IMC_RANGE, takes_tau_c=True),
        Rule(
            "amigo_pi",
            "AMIGO PI",
            "PI",
            {Fopdt: _amigo_pi, Integrating: _amigo_pi_integrating},
            f"{_AMIGO}; Advanced PID Control, 2006, eqs. 7.5 and 7.6",
        ),
        Rule(
            "amigo_pid",
            "AMIGO PID",
            "PID",
            {Fopdt: _amigo_pid, Integrating: _amigo_pid_integrating},
            f"{_AMIGO}; Advanced PID Control, 2006, eqs. 7.7 and 7.8",
            _AMIGO_PID_RANGE,
        ),
    )
}
"""All rules by the name that interfaces use."""


def rule_names() -> tuple[str, ...]:
    """Return the names of all rules, in the order of the table."""
    return tuple(RULES)


def rule_named(name: str) -> Rule:
    """Return the row of that name; capitals, blanks and hyphens do not matter.

    Raises
    ------
    InputError
        No rule has this name; the remedy lists all.
    """
    key = str(name).strip().lower().replace("-", "_").replace(" ", "_")
    if key not in RULES:
        raise InputError(
            "is not a known tuning rule", field="rule", value=name, remedy=f"Use one of {', '.join(RULES)}."
        )
    return RULES[key]
