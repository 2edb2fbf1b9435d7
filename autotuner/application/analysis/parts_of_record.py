"""Models of parts of a tuning's record: where no model fits the whole record, and to test the gains on each part.

A load step, or a wandering load, spoils every model that is fitted across it. The process alone explains a part
without the load. Its model is accepted for the record if it also explains the tail, to which nothing is fitted.

Gains are confirmed when they keep their robustness on models of separate parts: the relay, and the smaller moves after
it. Backlash, friction and an amplitude-dependent gain would make those models differ.

Every part is fitted from an unknown initial state, so the past does not matter. A load that spoils half of the record
spoils every part around that half, so those are not fitted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.application.analysis.learned import learned_models
from autotuner.core.design import margins
from autotuner.core.design.pid_design import judged_process
from autotuner.core.estimation.simulation import simulate_fit
from autotuner.core.identification import identify
from autotuner.core.identification.held_out import HeldOut
from autotuner.core.notes import Note
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design import PidGains
    from autotuner.core.identification import Identification
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

CHECK_BEGINS = "half_relay"
"""The first part of the record that the model of the relay part is judged on."""
NEVER_FITTED = "tail"
"""The part of the record that no model is fitted to."""
LAST_PARTS = (NEVER_FITTED, "return", "staircase", CHECK_BEGINS)
"""Parts that a model of an earlier stretch is judged on, the first that there is: a check cut short has no tail."""
FEWEST_TO_JUDGE = 20
"""Samples from which a part judges a model: the root mean square of their noise is known to 16 %, 1/sqrt(2 N)."""
HALVES = ((0.5, 1.0), (0.0, 0.5))
"""Shares of the record up to the tail that are fitted before the stretches around them."""
STRETCHES = ((0.0, 1.0), (1.0 / 3.0, 1.0), (0.0, 2.0 / 3.0), *HALVES, (0.25, 0.75))
"""Shares of the record up to the tail that are tried, the longest first."""
NOISE_ALONE = 1.2
"""Misfit over noise up to which a part is explained; of a short part chance alone reaches 1.1."""
SMALL = 0.02
"""Misfit of a part, as a share of the PV's standard deviation, that counts as explained whatever the noise."""
LONG_RELAY = 4.0
"""Periods of the relay part from which it is two parts."""
AS_ROBUST = 1.15
"""Ms on the model of a part, by that on the model of the gains, up to which these hold on it."""


def undisturbed(
    recording: Recording, structure: str, whole: Identification, is_spent: Callable[[], bool] | None = None
) -> tuple[Identification, HeldOut] | None:
    """Return the model of the longest stretch that is explained, with its error on the tail; None where none is.

    Parameters
    ----------
    recording : Recording
        A tuning's, with a check.
    structure : str
        As in `identify`.
    whole : Identification
        Identification of the whole record, with its limit cycle.
    is_spent : callable, optional
        As in `identify`.
    """
    begin, end = float(recording.t[0]), _last_part_begins(recording)
    if end is None:
        return None
    tail = recording.window(end, math.inf)

    @cache
    def explained(start_s: float, end_s: float) -> Identification | None:
        part = recording.window(start_s, end_s)
        found = identify(part, structure, learned=learned_models(), is_spent=is_spent)
        return found if found.model is not None and _explains(found, part) else None

    def seconds(shares: tuple[float, float]) -> tuple[float, float]:
        return begin + shares[0] * (end - begin), begin + shares[1] * (end - begin)

    for stretch in STRETCHES:
        if any(explained(*seconds(half)) is None for half in HALVES if _is_around(stretch, half)):
            continue
        start_s, end_s = seconds(stretch)
        if (found := explained(start_s, end_s)) is None or found.model is None:
            continue
        missed = _missed(found.model, recording.window(start_s, math.inf), end_s, tail)
        error = HeldOut(found.fit.rmse, missed, found.fit.noise_sigma, float(recording.pv.std()))
        if error.warning is None or error.is_small:
            note = Note(
                f"no model explains the whole record: something else moved the PV. The model is that of {start_s:.4g} "
                f"to {end_s:.4g} s, where nothing did, and it explains the last part, which was not fitted"
            )
            found = replace(found, limit_cycle=whole.limit_cycle or found.limit_cycle)
            return replace(found, warnings=(note, *found.warnings)), error
    return None


def _last_part_begins(recording: Recording) -> float | None:
    """Return when the part begins that models are judged on, s; None where none has enough samples."""
    begins = (recording.segments[name] for name in LAST_PARTS if name in recording.segments)
    return next((at_s for at_s in begins if np.count_nonzero(recording.t >= at_s) >= FEWEST_TO_JUDGE), None)


def hold_on_parts(
    recording: Recording,
    identification: Identification,
    gains: PidGains,
    sample_time_s: float,
    is_spent: Callable[[], bool] | None = None,
) -> bool:
    """Return whether gains are about as robust on models of separate parts as on the one they are for.

    At least two parts must be explained, each on its own, and one of them is the smaller moves after the relay.

    Parameters
    ----------
    recording : Recording
        A tuning's.
    identification : Identification
        The one that the gains rest on.
    gains : PidGains
        The gains.
    sample_time_s : float
        Sample time of the controller, s.
    is_spent : callable, optional
        As in `identify`.
    """
    segments = recording.segments
    if CHECK_BEGINS not in segments:
        return False
    begin, check, cycle = float(recording.t[0]), float(segments[CHECK_BEGINS]), identification.limit_cycle
    middle = (begin + check) / 2.0
    is_long = cycle is not None and check - begin > LONG_RELAY * cycle.Pu
    edges = [(begin, middle), (middle, check)] if is_long else [(begin, check)]
    most, seen = AS_ROBUST * _largest_sensitivity(identification, gains, sample_time_s), 0
    for start_s, end_s in [(check, math.inf), *edges]:
        part = recording.window(start_s, end_s)
        found = identify(part, identification.structure or "auto", is_spent=is_spent)
        if found.model is None or not _explains(found, part):
            if start_s == check:
                return False
            continue
        if _largest_sensitivity(found, gains, sample_time_s) > most:
            return False
        seen += 1
    return seen > 1


def _missed(model: ProcessModel, on: Recording, fitted_until_s: float, tail: Recording) -> float:
    """Return the residual of a model on the tail: from the state there, or with the drift of its part extrapolated."""
    carried = (on.pv - simulate_fit(model, on, fitted_until_s))[on.t >= tail.t[0]]
    return min(rms(carried), rms(tail.pv - simulate_fit(model, tail)))


def _is_around(stretch: tuple[float, float], half: tuple[float, float]) -> bool:
    return stretch[0] <= half[0] and half[1] <= stretch[1]


def _explains(found: Identification, part: Recording) -> bool:
    return found.fit.rmse <= max(NOISE_ALONE * found.fit.noise_sigma, SMALL * float(part.pv.std()))


def _largest_sensitivity(identification: Identification, gains: PidGains, sample_time_s: float) -> float:
    """Return Ms on an identified process; infinite where the loop is unstable."""
    judged = judged_process(identification.model, sample_time_s)[0]
    found = None if judged is None else margins(judged, gains)
    return math.inf if found is None or found.Ms is None or not found.stable else found.Ms
