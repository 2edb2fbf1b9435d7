"""Verdicts of the experiment when the process or the settings do not allow a result, with numbers and advice."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from autotuner.core.notes import Note
from autotuner.core.verdict import Verdict, aborted, refused

if TYPE_CHECKING:
    from autotuner.core.experiment.phases import Phase
    from autotuner.core.experiment.relay import Levels, Relay
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.signals.quiet import QuietMeasurement

WEAK = "Raise the relay amplitude, lower the hysteresis, or move the operating point away from the limit."
AT_LIMIT = (
    "The output rests at its limit, so nothing brings the PV back (the process may integrate). Bring the loop to an "
    "operating point at which the output rests inside its range, then start again."
)
ROUNDING = 1e-6
"""Noise below this share of the resolution comes from the arithmetic, not from the sensor."""


def output_outside(output: float, low: float, high: float) -> Verdict:
    """Refuse a loop whose output is outside of its limits."""
    return refused(
        "output_outside_limits",
        f"the output is at {output:g}, outside its limits {low:g} to {high:g}",
        "Bring the loop inside its limits, or correct limits.output.",
    )


def no_room(output: float, levels: Levels) -> Verdict:
    """Refuse a relay with a parallel controller where the output can move to one side only."""
    return refused(
        "no_room_beside_controller",
        f"the output is at {output:g}, at the edge of the relay's levels {levels.low:g} to {levels.high:g}: "
        "a controller beside the relay could not hold the PV there",
        "Bring the loop to an operating point inside its range, lower the amplitude, or leave the controller out.",
    )


def drifting(quiet: QuietMeasurement, settings: ExperimentSettings) -> Verdict:
    """Refuse a PV that does not rest."""
    noise = quiet.noise_sigma if quiet.noise_sigma > ROUNDING * quiet.resolution else 0.0
    held, advice = "while the output is held", "Wait until the process has settled, then start again"
    if settings.online is not None:
        held = "though the controller holds it"
        advice = "Wait until the controller has brought the PV to rest, check its gains, or leave it out"
    elif not settings.drift_compensation:
        advice += "; or allow the drift with drift_compensation"
    return refused(
        "pv_drifts",
        f"the PV drifts {quiet.drift_per_s * 60.0:.3g} a minute {held} "
        f"(watched for {quiet.duration_s:.3g} s, noise {noise:.3g})",
        f"{advice}.",
    )


def wrong_way(moved: float, level: float, *, direct: bool) -> Verdict:
    """Refuse a PV that answers in the direction opposite to the declared process action."""
    declared, other = ("direct", "reverse") if direct else ("reverse", "direct")
    return refused(
        "wrong_action",
        f"the PV moved by {moved:.3g} the wrong way when the output went to {level:g}: "
        f"the process has the opposite sign of process_action = {declared}",
        f"Set process_action = {other} for this loop, or check that output and PV belong together.",
    )


def perhaps_inverse(verdict: Verdict, seen: str, hysteresis: float) -> Verdict:
    """Add to a refusal that the response may be inverse; `hysteresis` would tolerate so large a dip."""
    return replace(
        verdict,
        message=f"{verdict.message}, or the response is inverse: the PV {seen}",
        remedy=f"{verdict.remedy} If the PV of this process first goes the other way, then comes (inverse response): "
        f"set relay.hysteresis to {hysteresis:.2g} or more, or lower the amplitude, so that the dip becomes smaller.",
    )


def no_response(level: float, quiet: QuietMeasurement, waited_s: float) -> Verdict:
    """Refuse a PV that does not answer."""
    return refused(
        "no_response",
        f"the PV stayed at {quiet.pv:.5g} within its noise for {waited_s:g} s at output {level:g}",
        "Check that the output reaches the actuator and that the sensor is alive; or raise the relay amplitude, or "
        "response_limit_s for a longer dead time.",
    )


def no_oscillation(relay: Relay, switches: int, pv: float, waited_s: float, *, at_limit: bool = False) -> Verdict:
    """Refuse a PV that does not return to the reference within the time limit of the experiment.

    From an output that rests at its limit there is no level beyond it that could bring back a PV that stays.
    """
    levels = f"{relay.low:g} and {relay.high:g}"
    return refused(
        "no_oscillation",
        f"no sustained oscillation: after {switches} switches the PV stayed at {pv:.5g} for {waited_s:.4g} s without "
        f"crossing {relay.reference:.5g} +- {relay.hysteresis:.3g}, with the output between {levels}",
        AT_LIMIT if at_limit else WEAK,
    )


def buried(peak: float, noise_sigma: float, amplitude: float) -> Verdict:
    """Refuse an oscillation that cannot be distinguished from the noise."""
    return refused(
        "oscillation_in_noise",
        f"the PV swings by +-{peak:.3g} under a relay of +-{amplitude:g}, "
        f"only {peak / noise_sigma:.2g} times its noise of {noise_sigma:.3g}",
        f"Raise the relay amplitude to {amplitude * 8.0 * noise_sigma / peak:.3g} or more, or filter the sensor.",
    )


def not_accurate(relative_error: float, settings: ExperimentSettings, periods: int) -> Note:
    """Report an oscillation that stayed irregular up to its end; gains allow for the errors of a model."""
    return Note(
        f"period and amplitude are known to {100.0 * relative_error:.2g} % only after {periods} periods, "
        f"{100.0 * settings.accuracy:g} % were requested: raise the relay amplitude or max_periods"
    )


def too_long(phase: Phase, limit_s: float) -> Verdict:
    """Abort a tuning whose time limit has passed."""
    return aborted(
        "time_limit",
        f"the time limit of {limit_s:g} s was reached in phase {phase}",
        "Raise time_limit_s, or use a larger accuracy or amplitude so that fewer periods are needed.",
    )
