"""Warnings and refusals about a model, with their numbers and the next action."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.drift import output_before
from autotuner.core.identification.result import most_unexplained, share_unexplained, what_looks_so
from autotuner.core.notes import SMALL_MISFIT, Doubt, Note
from autotuner.core.signals.feedback import is_kept_at_set_point, moves_all_the_time, set_point_moves
from autotuner.core.signals.noise import noise_sigma, resolution
from autotuner.core.verdict import Outcome, Verdict, refused

if TYPE_CHECKING:
    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.identification.frozen_samples import Stuck
    from autotuner.core.identification.result import Estimate
    from autotuner.core.identification.selection import Choice
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

FEWEST_SAMPLES = 10
"""Fewest samples of a recording: twice the parameters of the largest structure."""
NOTHING = 1e-60
"""Swing that counts as none: squares of smaller numbers vanish."""
VAGUE = 0.10
"""Relative half width of a 95 % interval beyond which a parameter counts as poorly known."""
RESTS_THERE = 0.02
"""Share of the motion left unexplained up to which a PV that rests at its extreme is no saturated sensor."""
MATTERS, SMALL = 2.0, 0.01
"""Standard errors, and relative change, by which a parameter has to hang on the moments of the changes to be named."""
COLOURED = 2.0
"""Inflation beyond which the residual is not noise alone."""
FEW_OUTLIERS = 0.02
"""Share of the samples up to which outliers are noted, not warned of."""
FEW_VALUES = 4
"""Number of different values of a PV that resembles a relay's output."""
COARSE = 2
"""Steps of the PV's resolution in its whole motion up to which nothing can be distinguished from it."""
LOCKED = 0.95
"""Correlation of two parameters above which only their ratio or product is known."""


def unusable(recording: Recording) -> Verdict | None:
    """Return a refusal for a recording that cannot show a process, whatever the method."""
    if len(recording) < FEWEST_SAMPLES:
        return refused(
            "too_few_samples",
            f"the recording has {len(recording)} samples, {FEWEST_SAMPLES} are the fewest",
            "Record for longer or sample faster.",
        )
    if np.ptp(recording.output) <= NOTHING:
        return refused(
            "constant_output",
            f"the output stays at {recording.output[0]:g} over {recording.duration_s:g} s",
            "Record while the output is moved: a relay test, a step or set-point changes.",
        )
    if np.ptp(recording.pv) <= NOTHING:
        return refused(
            "constant_pv",
            f"the PV stays at {recording.pv[0]:g} while the output moves by {np.ptp(recording.output):g}",
            "Check the sensor and its resolution, or move the output by more.",
        )
    values = np.unique(recording.pv).size
    if values <= FEW_VALUES and moves_all_the_time(recording) and not is_kept_at_set_point(recording):
        return refused(
            "columns_swapped",
            f"the PV has {values} values only, while the output is another one at nearly every sample",
            "Check which column is the output and which the PV, and name them the other way round.",
        )
    steps = round(float(np.ptp(recording.pv)) / resolution(recording.pv))
    if steps <= COARSE:
        return refused(
            "pv_too_coarse",
            f"the PV moves by {np.ptp(recording.pv):g} only, with a resolution of {resolution(recording.pv):g}",
            "Record the PV with finer resolution, or move the output by more.",
        )
    return None


def no_answer(recording: Recording, sigma: float) -> Verdict:
    """Return the refusal for a PV that does not follow the output."""
    return refused(
        "no_answer",
        f"the PV, which moves by {np.ptp(recording.pv):.4g} with noise of sigma {sigma:.4g}, shows no answer to the "
        f"output's moves of {np.ptp(recording.output):g}",
        "Move the output by more, record for longer, or check that output and PV belong to the same loop.",
    )


def controller_instead() -> Verdict:
    """Return the refusal for a closed loop whose best fit is the inverse of its controller."""
    return refused(
        "controller_instead_of_process",
        "the record shows the controller and not the process: the best fit is the inverse of the controller",
        "Record while the set point is moved, or move the output by hand.",
    )


def no_fit(structure: str) -> Verdict:
    """Return the refusal for a structure that the recording contradicts."""
    return refused(
        "structure_does_not_fit",
        f"no process of the structure {structure} comes near this recording",
        "Leave the structure to auto, or ask for another one.",
    )


def too_vague(model: ProcessModel, error: float) -> Verdict:
    """Return the refusal for a model that is too uncertain to design a controller for."""
    parameters = ", ".join(f"{name} {value:.3g}" for name, value in model.parameters().items())
    return refused(
        "too_vague",
        f"the record leaves the process open: the best fit is {model.structure} with {parameters}, but where a "
        f"controller would turn over its response is known to {error:.0%} only",
        "Move the output by more, or record for longer; in closed loop, move the set point.",
    )


def found(model: ProcessModel, fit_percent: float) -> Verdict:
    """Return the verdict of a success."""
    parameters = ", ".join(f"{name} {value:.4g}" for name, value in model.parameters().items())
    return Verdict(Outcome.DONE, "identified", f"{model.structure}: {parameters}; fit {fit_percent:.1f} %")


def warnings_about(
    recording: Recording, choice: Choice, estimate: Estimate, step: float, stuck: Stuck | None = None
) -> tuple[str, ...]:
    """Return the messages about a fit, most important first."""
    best = choice.best
    notes = [
        *_unexplained(best, recording, step),
        *_vague(estimate),
        *_locked(estimate),
        *_near_ties(choice),
        *_fed_back(recording),
        *_coloured(best, estimate, step, recording),
        *_beside_a_load(best),
        *_from_before(best, recording),
        *_outliers(best),
        *_moments(best),
        *_perhaps_between(choice, estimate),
        *_stuck(stuck, best, recording, step),
        *_beyond_the_record(best, recording),
    ]
    return (*recording.notes, *notes)


def _vague(estimate: Estimate) -> list[str]:
    """Return the parameters whose 95 % interval is wide."""
    assert estimate.model is not None  # noqa: S101 - warnings are about a model
    notes: list[str] = []
    for name, value in estimate.model.parameters().items():
        low, high = estimate.interval95.get(name, (value, value))
        if (high - low) / 2.0 > VAGUE * abs(value):
            text = f"this record leaves {name} uncertain: {value:.4g}, 95 % interval {low:.4g} to {high:.4g}"
            notes.append(Note(text))
    return notes


def _locked(estimate: Estimate) -> list[str]:
    """Return pairs of correlated uncertain parameters, with the ratio or product that is known better."""
    if estimate.model is None or estimate.covariance is None:
        return []
    values = estimate.model.parameters()
    names, x = list(values), np.array(list(values.values()))
    if not np.all(x != 0.0):
        return []
    relative = estimate.covariance / np.outer(x, x)
    error = np.sqrt(np.diag(relative))
    notes: list[str] = []
    for i in range(x.size):
        for j in range(i):
            r = relative[i, j] / (error[i] * error[j]) if error[i] * error[j] > 0.0 else 0.0
            if abs(r) < LOCKED or min(error[i], error[j]) < VAGUE / 2.0:
                continue
            sign = 1.0 if r > 0.0 else -1.0
            combined = x[j] / x[i] ** sign
            spread = math.sqrt(max(relative[i, i] + relative[j, j] - 2.0 * sign * relative[i, j], 0.0))
            symbol = "/" if sign > 0.0 else " "
            text = (
                f"{names[j]} and {names[i]} cannot be separated from this record: {names[j]}{symbol}{names[i]} is "
                f"{combined:.4g} +- {abs(combined) * spread:.2g}"
            )
            notes.append(Note(text))
    return notes


def _near_ties(choice: Choice) -> list[str]:
    names = [candidate.model.structure for candidate in choice.near_ties]
    others = [name for name in dict.fromkeys(names) if name != choice.best.model.structure]
    if not others:
        return []
    return [Note(f"{' and '.join(others)} would fit this record about as well as {choice.best.model.structure}")]


def _coloured(best: Candidate, estimate: Estimate, step: float, recording: Recording) -> list[str]:
    if best.inflation < COLOURED or best.rmse <= step:
        return []
    if estimate.evidence["noise_memory"]:
        return [
            Note(
                f"the noise on the PV is not white: {best.inflation:.2g} samples count as one, which the fit and its "
                "intervals reckon with"
            )
        ]
    text = (
        f"the residual of {best.rmse:.3g} is not noise alone: the process does something that the structure lacks; "
        f"the intervals are widened by {math.sqrt(best.inflation):.2g}"
    )
    small = best.rmse <= SMALL_MISFIT * float(np.std(recording.pv))
    return [Note(text) if small else Doubt(text)]


def odd_output_before(fitted: Candidate, recording: Recording) -> float | None:
    """Return the output before the record that a fit needs where it lies far beyond every one in it; else None."""
    before = output_before(fitted)
    if before is None:
        return None
    low, high = float(recording.output.min()), float(recording.output.max())
    claimed = float(recording.output[0]) + before
    return None if 2.0 * low - high <= claimed <= 2.0 * high - low else claimed


def _beside_a_load(best: Candidate) -> list[str]:
    """Return the size of the unmeasured disturbance where the process was found by the error of prediction."""
    if not best.memory:
        return []
    problem = best.solution.problem
    left = problem.left(best.solution.theta)[best.counts]
    text = (
        f"something that is not recorded moves the PV by {float(np.std(left)):.3g} (standard deviation) besides the "
        f"output: the model is the one that predicts every sample best from those before it, to {best.rmse:.3g}"
    )
    return [Note(text)]


def _from_before(best: Candidate, recording: Recording) -> list[str]:
    claimed = odd_output_before(best, recording)
    if best.inflation < COLOURED or claimed is None:
        return []
    low, high = float(recording.output.min()), float(recording.output.max())
    return [
        (
            f"the fit takes the output before the record to have been {claimed:.3g}, far outside the {low:.3g} to "
            f"{high:.3g} in it: something slower than this model moved the PV too (surroundings that warm up), and K "
            "and the lags are those of this record only; record from rest, or for longer"
        )
    ]


def _fed_back(recording: Recording) -> list[str]:
    """Return whether the output was a controller's, with nothing from outside (not even a relay) moving the loop."""
    moved_from_outside = set_point_moves(recording) or "online" in recording.settings
    if not moves_all_the_time(recording) or moved_from_outside:
        return []
    return [
        (
            "the output moves with nearly every sample: if a controller moved it and the record holds no set-point "
            "change, the fitted model may be that of the controller, not of the process"
        )
    ]


def _outliers(best: Candidate) -> list[str]:
    if not best.spikes:
        return []
    text = f"{best.spikes} samples were left out as outliers"
    problem = best.solution.problem
    few = best.spikes <= FEW_OUTLIERS * problem.data.t.size
    # In a record without noise the model misses corners of the response by what no controller feels.
    slight = np.abs(problem.left(best.solution.theta)).max() <= SMALL_MISFIT * float(np.std(problem.data.pv))
    return [Note(text) if few or slight else text]


def _moments(best: Candidate) -> list[str]:
    held, shaken = best.solution.problem.data.held, best.solution.problem.data.shaken
    if shaken is None or held.slack_s is None:
        return []
    D, slack = best.model.D, float(np.median(held.slack_s[1:]))
    error = best.uncertainty(profile=False).standard_error["D"]
    return [
        (
            f"the output changed between the samples, whose interval is {slack:.3g} s: the moments were estimated from "
            f"the PV, and D is {D:.4g} +- {error:.2g} s; record when each output was written to know it better"
        )
    ]


def _perhaps_between(choice: Choice, estimate: Estimate) -> list[str]:
    """Return the alternative parameters if the output had changed between the samples."""
    other, best = choice.between, choice.best
    if other is None or other.model.structure != best.model.structure:
        return []
    values, errors = other.model.parameters(), other.uncertainty(profile=False).standard_error
    differences = [
        f"{name} {values[name]:.4g} +- {errors[name]:.2g}"
        for name, value in best.model.parameters().items()
        if name != "D" and abs(values[name] - value) > MATTERS * max(estimate.standard_error[name], SMALL * abs(value))
    ]
    if not differences:
        return []
    return [
        (
            "this record does not show whether the output changed at its samples or between them; if it was sampled as "
            f"the PV was, {', '.join(differences)}: identify with moments `between`, or record when each output was "
            "written"
        )
    ]


def _stuck(stuck: Stuck | None, best: Candidate, recording: Recording, step: float) -> list[str]:
    if stuck is None:
        return []
    explained = best.white or unexplained_share(best, recording, step) <= RESTS_THERE
    if explained and best.counts[stuck.rows].all():
        return []  # explained with these samples: the process rests there
    left_out = bool((~best.counts & stuck.rows).any())
    return [*stuck.notes, *(["those samples were left out"] if left_out else [])]


def unexplained_share(best: Candidate, recording: Recording, step: float) -> float:
    """Return the share of the PV's motion that neither the fit nor noise or rounding to `step` explains."""
    sigma = max(noise_sigma(recording.pv), step / math.sqrt(12.0))
    return share_unexplained(best.rmse, sigma, recording.pv[best.counts])


def _unexplained(best: Candidate, recording: Recording, step: float) -> list[str]:
    share = unexplained_share(best, recording, step)
    if share <= most_unexplained(best.model):
        return []
    return [
        Doubt(
            f"{share:.0%} of the PV's motion is not explained by this model, nor noise: something else moved "
            f"the PV, or the process is of another kind; gains for it would be a guess{what_looks_so(best.model)}"
        )
    ]


def _beyond_the_record(best: Candidate, recording: Recording) -> list[str]:
    """Return whether the dynamics are slower than the record or faster than its samples."""
    slowest = max(best.solution.start.shape, default=0.0)
    if slowest > recording.duration_s:
        text = f"a time constant of {slowest:.3g} s is longer than the record of {recording.duration_s:.3g} s"
        return [Note(text)]
    if 0.0 < slowest < recording.sample_interval_s:
        return [
            Note(
                f"the time constant {slowest:.3g} s is under the sample interval {recording.sample_interval_s:.3g} s: "
                "sample faster to resolve it"
            )
        ]
    return []
