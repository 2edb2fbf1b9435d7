"""A time-proportioned output: a relay or a triac is on for a share of each period.

    x(t) = full   for t_k <= t < t_k + (u(t_k)/full) P,   0 for the rest of the period,      t_k = (k + f) P

or on while `u(t)` is above a carrier that rises from 0 to `full` in each period. `u` recorded output, `full` its
upper end, `P` period, `f` phase. The mean over a period is `u`; where the process is not much slower than the period,
the PV shows its ripple, and each command waits for half a period. (Pulse-width modulation with uniform and with natural
sampling: Holmes and Lipo, Pulse Width Modulation for Power Converters, 2003, section 3.)
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.waves import share_of_wave, spectral_lines
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.diagnosis.extended.extended_model import apart
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

FULL = (1.0, 100.0)
"""Upper ends of an output that is a share or a percentage; any other range is not known."""
LEAST_FULL = 0.1
"""Share of that end that the largest output reaches at least: below, the output is in other units."""
SHORTEST, FEWEST = 2.0, 8.0
"""Shortest period in sample intervals, and fewest periods in a record."""
PHASES, OF_EACH, MOST_LINES = 6, 2, 4
"""Phases, strongest lines of the spectrum of a signal, and most lines in all, from which a search begins."""
SAME_LINE = 0.5
"""Difference of two lines, in periods a record, below which they are one."""
RIPPLE = 0.15
"""Least share of a residual that the wave of a line explains: a ripple is regular."""
BEFORE = 20
"""Periods before the record: by then the ripple no longer depends on how it began."""
SEARCHED = ("", "by a carrier")
"""Forms by which a search comes to the effect."""
FORMS = (
    ("", True, BEFORE),
    ("by a carrier", False, BEFORE),
    ("from the start", True, 0),
    ("by a carrier from the start", False, 0),
)
"""All of them: whether a command counts for a whole period, and the periods with pulses before the record."""


def time_proportioning(dataset: Dataset, residuals: Sequence[FloatArray]) -> tuple[Effect, ...]:
    """Return the effect, where the range of the output is known, and a residual has a line to begin from."""
    output = dataset.data.held.levels + dataset.output0
    top, span, interval = float(output.max()), dataset.span_s, dataset.data.interval_s
    full = next((end for end in FULL if LEAST_FULL * end < top <= end), 0.0)
    if full == 0.0 or float(output.min()) < 0.0:
        return ()
    low, high = SHORTEST * interval, span / FEWEST
    pv, t = dataset.data.pv, dataset.data.t
    lines = [
        line
        for signal in (pv, np.gradient(pv, t), *residuals)  # a process that rings may have taken the ripple up
        for line in spectral_lines(dataset, signal)[:OF_EACH]
        if low < span / line < high and share_of_wave(dataset, signal, line) > RIPPLE
    ]
    lines = apart(lines, lambda one, other: abs(one - other), SAME_LINE, MOST_LINES)
    if not lines:
        return ()
    starts = [(math.log(span / line), k / PHASES) for line in lines for k in range(PHASES)]
    forms = {
        form: Effect(
            "time_proportioning",
            Place.ACTUATOR,
            (Searched("log_period", math.log(low), math.log(high), 1e-5), Searched("phase", -1.0, 2.0, 1e-4)),
            starts,
            lambda p, _c, _g: {"period_s": math.exp(p[0])},
            form=form,
            position=partial(_switched, full=full, latched=latched, before=before),
            order=4,
            price=math.log(len(starts)),
            group="timing",
            clocked=True,
        )
        for form, latched, before in FORMS
    }
    others = {form: tuple(e for e in forms.values() if e.form != form) for form in forms}
    return tuple(replace(forms[form], other_forms=others[form]) for form in SEARCHED)


def _switched(
    held: HeldInput, p: Sequence[float], dataset: Dataset, *, full: float, latched: bool, before: int
) -> HeldInput:
    until_s = float(dataset.data.t[-1])
    return pulses(held, dataset.output0, full, math.exp(p[0]), p[1], until_s, latched=latched, before=before)


def pulses(
    held: HeldInput,
    output0: float,
    full: float,
    period_s: float,
    phase: float,
    until_s: float,
    *,
    latched: bool = True,
    before: int = BEFORE,
) -> HeldInput:
    """Return a position that is either 0 or full, as deviation from the first output.

    Parameters
    ----------
    held : HeldInput
        The output, as deviation from its first value.
    output0 : float
        That value.
    full : float
        Its upper end.
    period_s, phase : float
        Period, s, and phase of the pulses, periods.
    until_s : float
        Time of the last pulse, s.
    latched : bool
        Whether the command at the begin of a period counts for all of it; otherwise a carrier looks at all of them.
    before : int
        Periods with pulses before the record. Before the first pulse the position is that of rest.
    """
    turns = np.arange(-math.floor(before + phase), math.ceil(until_s / period_s) + 1)
    begins = np.asarray((turns + phase) * period_s, dtype=np.float64)
    looks = begins if latched else np.union1d(begins, held.times[held.times > begins[0]])
    turn = np.searchsorted(begins, looks, side="right") - 1
    reached = begins[turn] + np.clip((held.at(looks) + output0) / full, 0.0, 1.0) * period_s
    lasts = np.append(looks[1:], begins[-1] + period_s)
    times = np.column_stack((looks, np.clip(reached, looks, lasts))).ravel()
    levels = np.tile((full - output0, -output0), looks.size)
    lasting = np.append(np.diff(times) > 0.0, [True])
    times, levels = times[lasting], levels[lasting]
    return HeldInput(np.append(times[0] - period_s, times), np.append(0.0, levels)).without_repeats()
