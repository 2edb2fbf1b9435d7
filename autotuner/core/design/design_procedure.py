"""Gains of a specification for a process, with the predicted response of the loop.

Invariants: gains are designed and predicted for the controller that will hold them. A
specification that costs much, or that cannot be met, results in gains and a warning.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.design.controller_advice import controller_advice
from autotuner.core.design.loop_margins import margins
from autotuner.core.design.pid_design import Candidate, judged_process, tune
from autotuner.core.design.requirements import MOVEMENT, Controller
from autotuner.core.design.simulation.closed_loop_setup import Installed, predicted_loop
from autotuner.core.notes import Note
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.controller_advice import ControllerAdvice
    from autotuner.core.design.design_spec import Basis, DesignSpec
    from autotuner.core.design.forms.held_gains import HeldGains
    from autotuner.core.design.pid_design import PidDesign

POOR = 1.3
"""Error after a load step, over that of a PID controller as robust, from which PI is warned of."""
NO_NOISE = "no noise was measured, so the requested limit of output jitter has no effect"


def design_from_spec(basis: Basis, spec: DesignSpec, *, compared: bool = True) -> PidDesign:
    """Return gains for a process by a specification; `compared` with all rules, as the alternatives.

    Raises
    ------
    InputError
        As of `tune`.
    """
    found = _with_quiet_output(basis, spec, _tuned(basis, spec, compared=compared))
    unlimited = (NO_NOISE,) if spec.jitter is not None and basis.noise is None else ()
    warnings = (*found.warnings, *unlimited, *_cost_of_controller(basis, spec))
    return replace(found, goal=None if spec.rule else spec.name, warnings=warnings)


def movement_limit(basis: Basis, spec: DesignSpec) -> float | None:
    """Return how much of the output may move for noise and resolution, output units; None where nothing limits it."""
    if spec.jitter is not None:
        return spec.jitter
    limit = MOVEMENT.get(spec.goal, MOVEMENT["balanced"]) * basis.output_span
    return limit if math.isfinite(limit) else None


def _with_quiet_output(basis: Basis, spec: DesignSpec, found: PidDesign) -> PidDesign:
    """Return gains that keep the goal's limit of output movement; where they keep it anyhow, they are as they were."""
    limit = movement_limit(basis, spec)
    if limit is None:
        return found
    alternatives = tuple(_with_movement_warning(candidate, limit) for candidate in found.alternatives)
    found = replace(found, jitter_limit=limit, alternatives=alternatives)
    if spec.jitter is not None or found.jitter is None or found.jitter <= limit:
        return found
    try:
        quiet = _tuned(basis, replace(spec, jitter=limit), compared=False) if spec.rule is None else found
    except InputError:
        quiet = found
    if quiet.jitter is None or quiet.jitter >= found.jitter:
        return replace(found, warnings=(*found.warnings, _works_for_nothing(found.jitter, limit)))
    cost = (
        f", and the error after a load step is {quiet.iae / found.iae:.2f} times as large"
        if quiet.iae and found.iae
        else ""
    )
    note = Note(
        f"noise and resolution of the PV would move the output by {found.jitter:.2g} (standard deviation); the gains "
        f"are chosen for {quiet.jitter:.2g}{cost}"
    )
    return replace(quiet, jitter_limit=limit, alternatives=alternatives, warnings=(*quiet.warnings, note))


def _with_movement_warning(candidate: Candidate, limit: float) -> Candidate:
    if candidate.jitter is None or candidate.jitter <= limit:
        return candidate
    return replace(candidate, warnings=(*candidate.warnings, _works_for_nothing(candidate.jitter, limit)))


def _works_for_nothing(jitter: float, limit: float) -> str:
    return (
        f"noise and resolution of the PV move the output by {jitter:.2g} (standard deviation, limit {limit:.2g}): the "
        "actuator would work for nothing; filter the PV, or take calmer gains"
    )


def _tuned(basis: Basis, spec: DesignSpec, *, compared: bool) -> PidDesign:
    return tune(
        basis.model,
        spec.requirements(basis.noise, basis.device),
        spec.rule,
        tau_c_s=spec.tau_c_s,
        covariance=basis.covariance,
        known_as=basis.known_as,
        sample_time_s=basis.sample_time_s,
        noise=basis.noise,
        device=basis.device,
        compared=compared,
    )


def _cost_of_controller(basis: Basis, spec: DesignSpec) -> tuple[str, ...]:
    """Return the cost of a controller with fewer parts than PID on this process, where it is large."""
    if spec.rule is not None or spec.controller == Controller.PID:
        return ()
    advice = _advice(basis)
    if spec.controller == Controller.P:
        share = "" if advice is None or advice.P is None else f", {100.0 * advice.P:.0f} % of what the load does alone,"
        cost = (
            f"a P controller leaves a lasting error{share} after a load step: ask for PI or PID unless that is wanted"
        )
        return (cost,)
    if advice is None or advice.PI <= POOR:
        return ()
    cost = (
        f"PI suits this process poorly: its error after a load step is {100.0 * (advice.PI - 1.0):.0f} % larger than "
        "that of a PID controller with the same robustness; ask for PID, whose derivative is filtered"
    )
    return (cost,)


def _advice(basis: Basis) -> ControllerAdvice | None:
    """Return which parts of a controller the process needs."""
    judged = judged_process(basis.model, basis.sample_time_s)[0]
    return None if judged is None else controller_advice(judged)


def with_prediction(found: PidDesign, basis: Basis, installed: Installed | None = None) -> PidDesign:
    """Return gains as held by the device, with the predicted response of the loop; their alternatives too.

    Gains that the device cannot hold are predicted as designed, with the reason among the warnings.

    Parameters
    ----------
    found : PidDesign
        The gains, as `design_from_spec` gives them.
    basis : Basis
        What they rest on.
    installed : Installed, optional
        The loop: limits, effects, size of the steps. Without it unit steps on the process alone.
    """
    setup = installed or Installed(basis.sample_time_s)
    judged = judged_process(basis.model, basis.sample_time_s)[0]
    held: HeldGains | None = None
    reasons: tuple[str, ...] = ()
    if basis.device is not None:
        try:
            held = basis.device.held(found.gains, judged)
        except InputError as error:
            reasons = (f"the device cannot hold these gains: {error.finding}",)
    run = held.gains if held else found.gains
    found = replace(
        found,
        held=held,
        margins=held.margins if held else found.margins,
        alternatives=tuple(_foreseen(candidate, basis, setup) for candidate in found.alternatives),
        warnings=(*found.warnings, *reasons, *(held.warnings if held else ())),
        advice=_advice(basis),
    )
    if judged is None or not margins(judged, run).stable:
        return found
    predicted = predicted_loop(basis.model, run, setup)
    iae = predicted.load_iae / abs(predicted.load_step) if run.Ki else None
    return replace(found, predicted=predicted, overshoot=predicted.overshoot if run.Ki else None, iae=iae)


def _foreseen(candidate: Candidate, basis: Basis, installed: Installed) -> Candidate:
    """Return a rule's gains, which are already as the device runs them, with the same prediction as the others."""
    if candidate.margins is None or not candidate.margins.stable or candidate.gains.Ki == 0.0:
        return candidate
    predicted = predicted_loop(basis.model, candidate.gains, installed)
    iae = predicted.load_iae / abs(predicted.load_step)
    return replace(candidate, iae=iae, overshoot=predicted.overshoot, settling_time_s=predicted.settling_time_s)
