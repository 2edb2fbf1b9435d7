"""Periodic disturbances.

    + a cos(w t) + b sin(w t)      on the PV; with harmonics (a triangle, a relay), growing with time, or begun late;
                                   of few periods in a record, a slow wave of the surroundings (`ambient`)
    u + A sin(w t + f)             at the input of the process, for one that answers to its own PV: dry friction
    u + A sgn(sin(w t + f))        the same, switched

Of a process that is linear otherwise, the two are the same.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.free_forms import shape_of
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

LINES = 4
"""Lines of the residual's spectrum from which a period is searched."""
OF_OTHERS, MOST_LINES = 2, 8
"""Lines that each further signal adds, and the most in all."""
FEWEST_PERIODS, FEWEST_ELSEWHERE = 2.0, 4.0
"""Fewest periods in a record that count as such: of a tuning, of anything else."""
MOST_PERIODS = 0.45
"""Most periods in a record over its samples: a little less than one in two samples, the limit of Nyquist."""
BEGINS = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Moments at which a wave may begin, in shares of the fitted part."""
SLOW_WAVE = "slow wave"
FEWEST_OF_A_SLOW_WAVE, SLOW = 0.4, (0.5, 0.9, 1.5, 2.5)
"""Fewest periods of a slow wave in a record, with less of which none would turn, and its starts."""
SHOWN = 100
"""Points by which the shape of a slow wave is judged."""
STEPS_OF_A_WAVE = 24
"""Steps in which a period at the input is written, of at least a sample: the largest harmonic of them is 4 %."""
LARGEST_LOAD = 3.0
"""Bound of a wave at the input, in swings of the output."""


def periodic_disturbances(dataset: Dataset, residuals: Sequence[FloatArray]) -> tuple[Effect, ...]:
    """Return waves on the PV, with starts from the spectra of residuals."""
    lines = lines_of_all(dataset, residuals)
    if not lines:
        return ()
    span = dataset.span_s

    def waves(harmonics: Sequence[int], form: str) -> Effect:
        def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
            angle = 2.0 * math.pi * math.exp(p[0]) / span * view.t
            # At the process's input it begins with the record: the process has a free response.
            waves = [wave(n * angle) for n in harmonics for wave in (np.cos, np.sin)]
            waves += [view.t / span * wave for wave in waves] if form == "growing" else []
            return [*waves, *(view.motion.free(view.t) if dataset.tuned else ())]

        def sizes(p: Sequence[float], c: Sequence[float], _g: float) -> Mapping[str, float]:
            cosine, sine = (c[0] + c[2], c[1] + c[3]) if form == "growing" else (c[0], c[1])  # at the end of the record
            return {"period_s": span / math.exp(p[0]), "amplitude": math.hypot(cosine, sine)}

        return Effect(
            "periodic_disturbance",
            Place.DISTURBANCE,
            (_periods(dataset),),
            [(math.log(line),) for line in lines],
            sizes,
            form=form,
            columns=columns,
            price=price_of_a_period(dataset),
        )

    return (
        waves((1,), ""),
        waves((1, 2, 3), "harmonics"),
        waves((1,), "growing"),
        _late_wave(dataset, lines),
    )


def _late_wave(dataset: Dataset, lines: Sequence[float]) -> Effect:
    """Return a wave that begins within the record."""
    span, interval = dataset.span_s, dataset.data.interval_s
    share = dataset.fitted_until_s / span

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        angle = 2.0 * math.pi * math.exp(p[0]) / span * view.t
        # A ramp over one sample, so that the search has a slope to go by.
        begun = np.clip((view.t - p[1] * span) / interval + 0.5, 0.0, 1.0)
        return [begun * np.cos(angle), begun * np.sin(angle)]

    return Effect(
        "periodic_disturbance",
        Place.DISTURBANCE,
        (_periods(dataset), Searched("moment", 0.02, 0.95, 1e-4)),
        [(math.log(line), at * share) for line in lines for at in BEGINS],
        lambda p, c, _g: {"period_s": span / math.exp(p[0]), "amplitude": math.hypot(*c[:2]), "from_s": p[1] * span},
        form="begins",
        columns=columns,
        price=price_of_a_period(dataset) + math.log(len(BEGINS)),
    )


def wave_at_the_input(dataset: Dataset, *, switched: bool = False) -> Effect:
    """Return a wave that a process which answers to its own PV feels, too; its size and phase are searched for.

    Parameters
    ----------
    dataset : Dataset
        The recording.
    switched : bool
        Whether it is a square wave: a load that is switched on and off.
    """
    span, swing = dataset.span_s, dataset.swing

    def load(p: Sequence[float], dataset: Dataset) -> HeldInput:
        periods, phase = math.exp(p[0]), math.atan2(p[2], p[1])
        ends, period_s = float(dataset.data.t[-1]), span / periods
        if switched:
            times = (np.arange(math.ceil(2.0 * ends / period_s) + 1) - phase / math.pi) * period_s / 2.0
            times = np.append(0.0, times[times > 0.0])
            middles = times + np.diff(times, append=times[-1] + period_s / 2.0) / 2.0
            shape = np.sign(np.sin(2.0 * math.pi / period_s * middles + phase))
        else:
            step_s = max(dataset.data.interval_s, period_s / STEPS_OF_A_WAVE)
            times = np.arange(0.0, ends, step_s)
            shape = np.sin(2.0 * math.pi / period_s * (times + step_s / 2.0) + phase)
        return HeldInput(np.append(0.0, times), np.append(0.0, swing * math.hypot(p[1], p[2]) * shape))

    return Effect(
        "periodic_disturbance",
        Place.DISTURBANCE,
        (
            _periods(dataset),
            Searched("sine", -LARGEST_LOAD, LARGEST_LOAD, 1e-4),
            Searched("cosine", -LARGEST_LOAD, LARGEST_LOAD, 1e-4),
        ),
        [],
        lambda p, _c, _g: {"period_s": span / math.exp(p[0]), "amplitude": math.hypot(p[1], p[2]) * swing},
        form="switched at the input" if switched else "at the input",
        load=load,
        price=price_of_a_period(dataset),
    )


def slow_wave(dataset: Dataset) -> Effect:
    """Return a sine of fewer periods than a periodic disturbance has, such as that of a day, which turns in the record.

    It enters the process, whose answer is a sine, too, and the motion from the state in which the record begins.
    """
    span = dataset.span_s

    def at(times: FloatArray, p: Sequence[float]) -> list[FloatArray]:
        angle = 2.0 * math.pi * math.exp(p[0]) / span * times
        return [np.cos(angle), np.sin(angle)]

    def means(p: Sequence[float], c: Sequence[float], _gain: float, _shape: Sequence[float]) -> bool:
        course = np.array(c[:2]) @ np.array(at(np.linspace(0.0, dataset.fitted_until_s, SHOWN), p))
        return shape_of(course) == "ambient"

    return Effect(
        "ambient",
        Place.DISTURBANCE,
        (Searched("log_periods", math.log(FEWEST_OF_A_SLOW_WAVE), math.log(fewest_periods(dataset)), 1e-4),),
        [(math.log(periods),) for periods in SLOW],
        lambda p, c, _g: {"period_s": span / math.exp(p[0]), "amplitude": math.hypot(c[0], c[1])},
        form=SLOW_WAVE,
        columns=lambda view, p: [*at(view.t, p), *(view.motion.free(view.t) if dataset.settled_first else ())],
        price=2.0,
        group="slow",
        means=means,
    )


def fewest_periods(dataset: Dataset) -> float:
    """Return how many periods in a record count as such."""
    return FEWEST_PERIODS if dataset.tuned else FEWEST_ELSEWHERE


def _most_periods(dataset: Dataset) -> float:
    return MOST_PERIODS * dataset.data.t.size


def _periods(dataset: Dataset) -> Searched:
    """Return the logarithm of the number of periods in a record as a searched number."""
    return Searched("log_periods", math.log(fewest_periods(dataset)), math.log(_most_periods(dataset)), 1e-5)


def price_of_a_period(dataset: Dataset) -> float:
    """Return the price of a period: as many are tried as the record can show."""
    return math.log(max(_most_periods(dataset), 2.0))


def share_of_wave(dataset: Dataset, signal: FloatArray, line: float) -> float:
    """Return the share of a signal's variance about a straight line, on the fitted part, that a wave explains."""
    t, signal = dataset.data.t[dataset.fitted], signal[dataset.fitted]
    angle = 2.0 * math.pi * line / dataset.span_s * t
    straight = residual_after(np.column_stack((np.ones(t.size), t)), signal)
    left = residual_after(np.column_stack((np.ones(t.size), t, np.cos(angle), np.sin(angle))), signal)
    return 1.0 - float(left @ left) / max(float(straight @ straight), SMALLEST_DIVISOR)


def lines_of_all(dataset: Dataset, residuals: Sequence[FloatArray]) -> list[float]:
    """Return the lines of the first residual, and those that only others show, or the moves of the PV."""
    lines = spectral_lines(dataset, residuals[0])
    for signal in (*residuals[1:], np.gradient(dataset.data.pv, dataset.data.t)):
        lines += [
            f for f in spectral_lines(dataset, signal)[:OF_OTHERS] if all(abs(f - other) > 1.0 for other in lines)
        ]
    return lines[:MOST_LINES]


def spectral_lines(dataset: Dataset, residual: FloatArray) -> list[float]:
    """Return the strongest lines of the residual's spectrum on the fitted part, in periods per record."""
    rows = np.flatnonzero(dataset.fitted)
    t = dataset.data.t[rows]
    even = np.linspace(t[0], t[-1], rows.size)
    values = np.interp(even, t, residual[rows])
    values = (values - values.mean()) * np.hanning(values.size)
    power = np.abs(np.fft.rfft(values, 4 * values.size)) ** 2
    periods = np.arange(power.size) / 4.0 * dataset.span_s / (t[-1] - t[0])
    power[(periods < fewest_periods(dataset)) | (periods > _most_periods(dataset))] = 0.0
    found = []
    for _ in range(LINES):
        top = int(np.argmax(power))
        if power[top] == 0.0:
            break
        found.append(float(periods[top]))
        power[np.abs(periods - periods[top]) < 2.0] = 0.0
    return found
