"""Simulated experiments for training: processes and relays drawn, run, and read as a live record is read.

What is varied: ratio of dead time to lags, damping, sampling ratio, noise, hysteresis, bias of the relay, half periods
seen, and where the static gain is from (given, shown by the relay's asymmetry, or given wrongly). A share of the
experiments is free of noise. Time in samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner.core.identification.learned.correction import features, shape_features
from autotuner.core.identification.limit_cycle.harmonic_start import start
from autotuner.core.identification.limit_cycle.relay_harmonics import RelayWaves, cycles_of, waves
from autotuner_models.learned.experiments import ON_SIGMA, Processes, Relays, run

if TYPE_CHECKING:
    from autotuner_models.learned.experiments import Numbers, Records, Rows

STRUCTURES = ("fopdt", "sopdt_overdamped", "sopdt_underdamped", "integrating")
REST_SAMPLES = 40
"""Samples at rest before the relay, as a quiet phase of usual length has."""
HALF_PERIODS = (3, 12)
"""Switches after which a record is read: fewest and most."""
SAMPLING = (20.0, 400.0)
"""Samples a period."""
SAME = 0.25
"""Relative difference of the last two periods up to which a record is an oscillation that repeats."""
LARGEST_GAIN_ERROR = 0.3
"""Relative standard error of a gain up to which a model is shown that gain."""
LEAST_NOISE = 1e-4
"""Standard deviation of the noise, over the amplitude, under which a record is free of noise."""
NOISY = 0.75
"""Share of the experiments with noise where the range of the noise begins at none."""
TOGETHER = 256
"""Processes run at once."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Common conditions of a batch of experiments; None: drawn at random.

    Attributes
    ----------
    switches : int, optional
        Switches after which the record is read.
    per_period : float, optional
        Samples a period.
    decibels : float, optional
        Mean square of the oscillation over that of the noise; infinite without noise.
    gain_given : bool
        Whether the static gain is always given exactly.
    ranges : mapping
        Ranges of the process's ratios that replace `RATIOS`.
    noise : (float, float)
        Range of the noise's standard deviation, over the amplitude of the oscillation.
    """

    switches: int | None = None
    per_period: float | None = None
    decibels: float | None = None
    gain_given: bool = False
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    noise: tuple[float, float] = (0.0, 0.25)


class Rowset(NamedTuple):
    """Rows for training: features with and without the static gain, truth and start in a structure's coordinates."""

    X: Numbers
    shape: Numbers
    truth: Numbers
    start: Numbers
    scale: Numbers
    """Relative standard error of the gain, period in samples, and noise level: for tables."""


RATIOS: dict[str, tuple[float, float]] = {
    "D/T": (0.03, 15.0),
    "T2/T1": (0.05, 1.0),
    "damping": (0.09, 0.999),
    "D/sum": (0.02, 8.0),
    "D/root m": (0.1, 16.0),
    "T/D": (0.03, 10.0),
}
"""Ranges of the ratios that make a process, drawn evenly on a logarithmic scale."""


def draw_processes(
    structure: str, count: int, rng: np.random.Generator, ranges: dict[str, tuple[float, float]]
) -> Processes:
    """Return processes of unit gain in a unit of time of their own."""
    spans = RATIOS | ranges

    def log_even(name: str) -> Numbers:
        low, high = spans[name]
        even: Numbers = np.exp(rng.uniform(math.log(low), math.log(high), count))
        return even

    one, zero = np.ones(count), np.zeros(count)
    if structure == "fopdt":
        return Processes(one, one, one, zero, log_even("D/T"))
    if structure == "sopdt_overdamped":
        T2 = log_even("T2/T1")
        return Processes(one, one, 1.0 + T2, T2, (1.0 + T2) * log_even("D/sum"))
    if structure == "sopdt_underdamped":
        return Processes(one, one, 2.0 * log_even("damping"), one, log_even("D/root m"))
    return Processes(one, zero, one, log_even("T/D"), one)


def turnover(processes: Processes) -> Numbers:
    """Return the frequency at which the response lags by half a turn, by bisection."""
    _, a0, a1, a2, D = processes
    low, high = np.full(D.size, 1e-6), math.pi / D
    for _ in range(60):
        w = (low + high) / 2.0
        behind = w * D + np.angle(a0 - a2 * w * w + 1j * a1 * w) < math.pi
        low, high = np.where(behind, w, low), np.where(behind, high, w)
    return low


def draw(
    structure: str, count: int, rng: np.random.Generator, conditions: Conditions
) -> tuple[RelayWaves, Numbers, Numbers, Numbers]:
    """Run a batch; return the waves, the true coordinates, and the static gain with its relative error, over scales.

    Experiments without a steady oscillation are omitted.
    """
    processes = draw_processes(structure, count, rng, conditions.ranges)
    w = turnover(processes)
    per_period = conditions.per_period or math.exp(rng.uniform(math.log(SAMPLING[0]), math.log(SAMPLING[1])))
    stretch = per_period * np.exp(rng.uniform(-0.2, 0.2, count)) * w / (2.0 * math.pi)
    processes = _stretched(processes, stretch)
    w = w / stretch
    relays = _relays(processes, w, rng, conditions)
    switches = conditions.switches or int(rng.integers(HALF_PERIODS[0], HALF_PERIODS[1] + 1))
    longest = int(per_period * 1.25 * 2.5 * (switches / 2.0 + 1.5))
    records = run(processes, relays, switches, longest, rng)
    wave, kept = read(records, relays.sigma, rng)
    return wave, *_known(structure, Processes(*(c[kept] for c in processes)), wave, rng, conditions)


def run_known(
    processes: Processes, per_period: float, switches: int, decibels: float, rng: np.random.Generator
) -> tuple[RelayWaves, Numbers, Rows]:
    """Run given processes under a symmetric relay; times in s.

    Returns
    -------
    RelayWaves
        Their waves, of those that repeat.
    array of float
        The frequency of each, rad/s.
    array of int
        Which processes these are.
    """
    parts = [
        _run_known(Processes(*(c[i : i + TOGETHER] for c in processes)), per_period, switches, decibels, rng)
        for i in range(0, processes.D.size, TOGETHER)
    ]
    waves_, w, kept = zip(*parts, strict=True)
    whole = RelayWaves(*(np.concatenate(column) for column in zip(*waves_, strict=True)))
    return whole, np.concatenate(w), np.concatenate([k + i * TOGETHER for i, k in enumerate(kept)])


def _run_known(
    processes: Processes, per_period: float, switches: int, decibels: float, rng: np.random.Generator
) -> tuple[RelayWaves, Numbers, Rows]:
    w = turnover(processes)
    stretch = per_period * w / (2.0 * math.pi)
    p, w = _stretched(processes, stretch), w / stretch
    sigma = _amplitude(p, w) / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    one = np.ones(w.size)
    relays = Relays(-one, one, ON_SIGMA * sigma, sigma)
    records = run(p, relays, switches, int(per_period * 1.5 * (switches / 2.0 + 2.0)), rng)
    wave, kept = read(records, sigma, rng)
    return wave, 2.0 * math.pi / wave.Pu * stretch[kept], kept


def _amplitude(p: Processes, w: Numbers) -> Numbers:
    """Return the amplitude that the describing function predicts under a relay of height 1."""
    amplitude: Numbers = 4.0 / math.pi * np.abs(p.b / (p.a0 - p.a2 * w * w + 1j * p.a1 * w))
    return amplitude


def _stretched(p: Processes, by: Numbers) -> Processes:
    """Return the same processes in another unit of time; an integrator's gain is stretched back."""
    return Processes(p.b, p.a0, p.a1 * by, p.a2 * by**2, p.D * by)


def _relays(p: Processes, w: Numbers, rng: np.random.Generator, conditions: Conditions) -> Relays:
    count = w.size
    A = _amplitude(p, w)
    if conditions.decibels is None:
        least, most = (max(value, LEAST_NOISE) for value in conditions.noise)
        noisy = rng.random(count) < (NOISY if conditions.noise[0] < LEAST_NOISE else 1.0)
        sigma = A * np.where(noisy, np.exp(rng.uniform(math.log(least), math.log(most), count)), 0.0)
    else:
        sigma = A / math.sqrt(2.0) * 10.0 ** (-conditions.decibels / 20.0) * np.ones(count)
    bias = np.where(rng.random(count) < 0.25, 0.0, rng.uniform(-0.6, 0.6, count))
    zone = np.where(rng.random(count) < 0.3, 0.0, rng.uniform(0.0, 0.4, count)) * A
    # a level must lead beyond its threshold with room to spare, or the oscillation never comes
    reach = np.where(p.a0 > 0.0, (1.0 - np.abs(bias)) * 0.7, np.inf)
    hysteresis = np.minimum(np.maximum(zone, ON_SIGMA * sigma), reach)
    return Relays(bias - 1.0, bias + 1.0, hysteresis, sigma)


def read(records: Records, sigma: Numbers, rng: np.random.Generator) -> tuple[RelayWaves, Rows]:
    """Return the waves of the records that repeat, and which they are."""
    switches = records.switches
    count = switches.shape[0]
    cycles = cycles_of(count)
    done = switches[-1] > 0
    halves = np.diff(np.vstack((switches, switches[-1:])), axis=0)[:-1].astype(np.float64)
    steady = np.all(halves[-2:] > 0.1 * halves.max(axis=0), axis=0)
    if count > 3:
        steady &= np.abs(halves[-3] - halves[-1]) < SAME * halves[-1] + 2.0
    kept = np.flatnonzero(done & steady)
    begin, end = switches[-2 * cycles - 1, kept], switches[-1, kept]
    rows = np.minimum(begin + np.arange(int((end - begin).max()) + 1)[:, None], end)
    pv, output = records.pv[rows, kept].T, records.output[rows, kept].T
    rest = np.stack((sigma[kept] / math.sqrt(REST_SAMPLES) * rng.standard_normal(kept.size), np.zeros(kept.size)))
    measured = sigma[kept] * np.exp(0.08 * rng.standard_normal(kept.size))
    t = rows.T.astype(np.float64)
    return waves(
        t, np.ascontiguousarray(pv), np.ascontiguousarray(output), cycles, measured, (rest, REST_SAMPLES)
    ), kept


def _known(
    structure: str, p: Processes, wave: RelayWaves, rng: np.random.Generator, conditions: Conditions
) -> tuple[Numbers, Numbers, Numbers]:
    """Return true coordinates, static gain over scales as it is known, and its relative error."""
    w, ratio = 2.0 * math.pi / wave.Pu, wave.U1 / wave.A1
    if structure == "integrating":
        r = p.b / p.a1 / w * ratio
        T = p.a2 / p.a1
        return np.stack((np.log1p(T * w), p.D * w, np.log(r)), axis=1), np.ones(w.size), np.zeros(w.size)
    r = p.b / p.a0 * ratio
    common = (p.D * w, np.log(r))
    m, n = p.a2 / p.a0 * w**2, p.a1 / p.a0 * w
    if structure == "fopdt":
        lags: tuple[Numbers, ...] = (np.log(n),)
    elif structure == "sopdt_underdamped":
        lags = (np.log(m), np.log(n))
    else:
        T1 = n / 2.0 + np.sqrt(np.maximum(n * n / 4.0 - m, 0.0))
        lags = (np.log(T1), np.log(m / T1))
    truth = np.stack((*lags, *common), axis=1)
    return truth, *_gain(r, wave, rng, conditions)


def _gain(r: Numbers, wave: RelayWaves, rng: np.random.Generator, conditions: Conditions) -> tuple[Numbers, Numbers]:
    if conditions.gain_given:
        return r, np.zeros(r.size)
    source = rng.random(r.size)
    shown_error = wave.gain_error / np.abs(wave.gain)
    shown = (source < 0.45) & (wave.gain > 0.0) & (shown_error < LARGEST_GAIN_ERROR)
    wrong = (source >= 0.45) & (source < 0.6)
    size = np.exp(rng.uniform(math.log(1e-3), math.log(0.08), r.size))
    off = np.exp(size * rng.standard_normal(r.size))
    return (
        np.where(shown, wave.gain, np.where(wrong, r * off, r)),
        np.where(shown, shown_error, np.where(wrong, size, 0.0)),
    )


def rows_of(structure: str, count: int, seed: tuple[int, ...], conditions: Conditions | None = None) -> Rowset:
    """Return the training rows of one batch; the same seed gives the same rows."""
    rng = np.random.default_rng(seed)
    wave, truth, r, gain_error = draw(structure, count, rng, conditions or Conditions())
    begun = start(structure, wave, r)
    kept = begun.exists & np.isfinite(truth).all(axis=1)
    X = features(wave, r, gain_error, begun)
    scale = np.stack((gain_error, wave.Pu, wave.noise), axis=1)
    return Rowset(X[kept], shape_features(wave)[kept], truth[kept], begun.values[kept], scale[kept])
