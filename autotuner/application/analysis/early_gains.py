"""Gains while the relay still runs: a rule on the model of the record so far, at the cautious bound of its errors.

The learned correction has a model after two or three half periods, milliseconds after the switch. Its gains are used
when a test ends early, until those of the whole record exist.

    K + q e_K,   D + q e_D,   T - q e_T (but a tenth of T at least)

`e` are the calibrated standard errors of the model, `q` the normal 97.5 % quantile: a larger gain, a longer dead time
and a shorter lag all make the controller slower. Half a sample for the hold of the output is added to the dead time.

SIMC with `tau_c = D` (Skogestad, J. Process Control 13, 2003). Its derivative has no filter; with one the loop has more
lag, so `tau_c` grows until `Ms` on this process is within `MOST_MS`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.design.loop_margins import margins
from autotuner.core.design.rules.tuning_rules import apply_rule
from autotuner.core.identification import RunningModel
from autotuner.core.identification.running_estimate import relative_error
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped, model_from_dict
from autotuner.core.quantiles import NORMAL_95
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.rules.tuning_rules import RuleResult
    from autotuner.core.identification import Identification
    from autotuner.core.model.process import ProcessModel

RULES: dict[type, str] = {
    Fopdt: "simc_pi",
    SopdtOverdamped: "simc_pid",
    SopdtUnderdamped: "simc_pid",
    Integrating: "simc_pid",
}
"""The rule for each process that a running model may be."""
LEAST = 0.1
"""Lower bound of the cautious time constant, as a share of the estimate."""
MOST_MS = 1.6
"""Largest sensitivity on the cautious process; SIMC with `tau_c = D` has 1.59 where the dead time is the only delay."""
SLOWER = (1.0, 1.2, 1.45, 1.75, 2.1, 2.5)
"""Closed-loop times that are tried, in that of the rule."""
LARGEST_ERROR = 0.3
"""Relative error of a model from which no gains are offered for it."""


def with_gains(running: RunningModel | None, sample_time_s: float) -> RunningModel | None:
    """Return a running model with gains for it; without, where it explains too little or no rule takes it.

    Parameters
    ----------
    running : RunningModel or None
        A model of the record so far.
    sample_time_s : float
        Sample time of the loop, s: the least dead time that a controller sees.
    """
    found = early_rule(running, sample_time_s)
    if running is None or found is None:
        return running
    return replace(running, gains={**found.gains.to_dict(), "rule": found.rule})


def early_rule(running: RunningModel | None, sample_time_s: float) -> RuleResult | None:
    """Return the rule's gains for a model; None where it explains too little or no rule takes it."""
    if running is None or not running.explains or running.relative_error > LARGEST_ERROR:
        return None
    try:
        model = cautious(running)
        held = replace(model, D=model.D + sample_time_s / 2.0)  # type: ignore[type-var]
        return _robust(RULES[type(model)], held, max(held.D, sample_time_s))
    except (InputError, KeyError):
        return None


def _robust(rule: str, model: ProcessModel, tau_c_s: float) -> RuleResult | None:
    """Return the rule's gains for the shortest closed-loop time that keeps the limit; None where none does."""
    for slower in SLOWER:
        found = apply_rule(rule, model, tau_c_s=slower * tau_c_s)
        Ms = margins(model, found.gains).Ms
        if Ms is not None and Ms <= MOST_MS:
            return found
    return None


def cautious(running: RunningModel) -> ProcessModel:
    """Return the model at the bound of its errors that requires the slowest controller."""
    values, errors = running.model.parameters(), running.standard_error
    for name in values.keys() & {"K", "D", "T", "T1", "T2"}:
        margin = NORMAL_95 * errors.get(name, 0.0)
        grown = abs(values[name]) + (margin if name in {"K", "D"} else -margin)
        size = grown if name in {"K", "D"} else max(grown, LEAST * abs(values[name]))
        values[name] = size if values[name] >= 0.0 else -size
    if {"T1", "T2"} <= values.keys():
        values["T1"], values["T2"] = max(values["T1"], values["T2"]), min(values["T1"], values["T2"])
    return model_from_dict(values, running.model.structure)


def in_no_time(identification: Identification, sample_time_s: float) -> dict[str, object] | None:
    """Return gains for an identification without a search for them, JSON-ready; None where no rule takes its model."""
    running = with_gains(running_of(identification), sample_time_s)
    return None if running is None or running.gains is None else dict(running.gains)


def running_of(identification: Identification) -> RunningModel | None:
    """Return the recommended model of an identification as one of a running tuning; None without one."""
    estimate = identification.estimates.get(identification.recommended or "")
    if estimate is None or estimate.model is None:
        return None
    error = relative_error(estimate.model.parameters(), estimate.standard_error)
    return RunningModel(estimate.model, estimate.standard_error, error, estimate.method)
