"""The four data sets of the thesis's chapter 4, from exact limit cycles.

    FOPDT         585 rows   39 values of T times 15 pairs (K, D)         features h, K, A, Pu, T_df, D_df
    FOPDT, noise  585        the same, white noise 20 dB under the PV     the same, of a noisy record
    overdamped   1435        drawn from the grids                         h, K, D, A1, Pu, T1_df, T2_df
    underdamped   732        drawn from the grids                         h, K, D, A1, Pu, m_df, n_df

K 1 to 15 and D 1 to 12 by 1, time constants 1 to 20 by 0.5 (section 4.2); n by 0.1, without which example 6's figures
could not come out. `off_grid` draws the same ranges continuously, `out_of_range` beyond them. The amplitude is the
peak for FOPDT and the fundamental for SOPDT, as the thesis's numbers show. K PV/output, A, A1 PV, times s, m s^2.

The noise reaches the relay: it moves the switches, so period and amplitude are those of a noisy oscillation, and the
relay has a dead zone of three standard deviations, without which it would chatter. The amplitude is read from the PV
after a band-pass (zero phase). The formulas are the thesis's, for an ideal relay: the dead zone is learned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from autotuner_models.estimates import H
from autotuner_models.learned.experiments import ON_SIGMA, Processes, Relays, run
from autotuner_sim.relay.batch import relay_tests, run_relay_tests

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from autotuner_models.learned.experiments import Records
    from autotuner_sim.relay.batch import RelayBatch

    Numbers = NDArray[np.float64]

T_GRID = np.arange(1.0, 20.25, 0.5)
N_GRID = np.arange(0.3, 9.0, 0.1)
FIRST_PAIR, LAST_PAIR = (1.0, 2.0), (9.0, 8.0)
"""Static gain and dead time of the first and last rows of table 4.1."""
PAIRS = 15
"""Pairs of gain and dead time: rows of the thesis's table 4.1."""
GRID, OFF_GRID, OUT_OF_RANGE = "grid", "off_grid", "out_of_range"
LEAST_DAMPING = 0.1
"""Least damping ratio of a drawn process that rings."""
DECIBELS = 20.0
"""Signal-to-noise ratio of the noisy records, dB: that of the thesis."""
PER_PERIOD, PERIODS, SETTLING = 200, 8, 3
"""Samples a period of the noisy records, periods read, and periods before them that are not."""
BAND = (0.4, 12.0)
"""Corners of the band-pass, in frequencies of the oscillation."""


class Plants(NamedTuple):
    """Processes `K e^{-Ds}/(m s^2 + n s + 1)`, one an element; `m = 0` and `n = T` for a single lag."""

    K: Numbers
    D: Numbers
    m: Numbers
    n: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class DataSet:
    """Rows for a regressor.

    Attributes
    ----------
    name, structure : str
        Which set.
    features, targets : tuple of str
        Names of the columns.
    X, Y : array of float, shapes (N, F) and (N, 2)
        Features and true parameters; the last two features are the describing function's estimates of the targets.
    plants : Plants
        The processes themselves.
    """

    name: str
    structure: str
    features: tuple[str, ...]
    targets: tuple[str, str]
    X: Numbers
    Y: Numbers
    plants: Plants


def data_set(name: str, where: str = GRID, seed: int = 1) -> DataSet:
    """Return one of `SETS` on the thesis's grid, off it, or out of its range."""
    return SETS[name](where, np.random.default_rng(seed))


def _fopdt_plants(where: str, rng: np.random.Generator) -> Plants:
    if where == GRID:
        gains = rng.permutation(np.setdiff1d(np.arange(1.0, 16.0), (FIRST_PAIR[0], LAST_PAIR[0])))
        others = zip(gains, rng.integers(1, 13, PAIRS - 2), strict=True)
        K, D = np.array([FIRST_PAIR, *others, LAST_PAIR]).T
        return Plants(*(column.ravel() for column in np.broadcast_arrays(K[:, None], D[:, None], 0.0, T_GRID)))
    K, D, T = (rng.uniform(*span, 1000) for span in ((1.0, 15.0), (1.0, 12.0), (1.0, 20.0)))
    T = rng.uniform(20.0, 40.0, 1000) if where == OUT_OF_RANGE else T
    return Plants(K, D, np.zeros(1000), T)


def _fopdt(where: str, rng: np.random.Generator) -> DataSet:
    plants = _fopdt_plants(where, rng)
    cycle = _cycles(plants)
    return _first_order("fopdt", plants, cycle.peak, cycle.period_s)


def _noisy_fopdt(where: str, rng: np.random.Generator) -> DataSet:
    plants = _fopdt_plants(where, rng)
    cycle = _cycles(plants)
    return _first_order("fopdt_noise", plants, *noisy_cycles(plants, cycle, rng))


def _first_order(name: str, plants: Plants, A: Numbers, Pu: Numbers) -> DataSet:
    w, N = 2.0 * math.pi / Pu, 4.0 * H / (math.pi * A)
    T_df = np.sqrt(np.maximum((N * plants.K) ** 2 - 1.0, 0.0)) / w
    D_df = (math.pi - np.arctan(w * T_df)) / w
    X = np.column_stack((np.full(A.size, H), plants.K, A, Pu, T_df, D_df))
    names = ("h", "K", "A", "Pu", "T_df", "D_df")
    return DataSet(name, "fopdt", names, ("T", "D"), X, np.column_stack((plants.n, plants.D)), plants)


def _overdamped(where: str, rng: np.random.Generator) -> DataSet:
    def draw(count: int) -> Plants:
        lags = _lags(where, rng, (2, count))
        (T1, T2), (K, D) = (lags.max(axis=0), lags.min(axis=0)), _gain_and_dead_time(where, rng, count)
        return Plants(K, D, T1 * T2, T1 + T2)

    return _second_order("overdamped", "sopdt_overdamped", ("T1", "T2"), draw, 1435, _as_lags)


def _underdamped(where: str, rng: np.random.Generator) -> DataSet:
    def draw(count: int) -> Plants:
        m = _lags(where, rng, (count,))
        n = rng.choice(N_GRID, count) if where == GRID else rng.uniform(N_GRID[0], N_GRID[-1], count)
        rings = (n < 2.0 * np.sqrt(m)) & (n > 2.0 * LEAST_DAMPING * np.sqrt(m))
        K, D = _gain_and_dead_time(where, rng, count)
        return Plants(K[rings], D[rings], m[rings], n[rings])

    return _second_order("underdamped", "sopdt_underdamped", ("m", "n"), draw, 732, lambda m, n: (m, n))


def _second_order(
    name: str,
    structure: str,
    targets: tuple[str, str],
    draw: Callable[[int], Plants],
    rows: int,
    as_targets: Callable[[Numbers, Numbers], tuple[Numbers, Numbers]],
) -> DataSet:
    plants = draw(8 * rows)
    cycle = _cycles(plants)
    simple = np.flatnonzero(cycle.turns_once)[:rows]
    plants = Plants(*(column[simple] for column in plants))
    A1, Pu = cycle.fundamental[simple], cycle.period_s[simple]
    w, N = 2.0 * math.pi / Pu, 4.0 * H / (math.pi * A1)
    m_df = (1.0 + N * plants.K * np.cos(w * plants.D)) / w**2
    n_df = N * plants.K * np.sin(w * plants.D) / w
    X = np.column_stack((np.full(simple.size, H), plants.K, plants.D, A1, Pu, *as_targets(m_df, n_df)))
    names = ("h", "K", "D", "A1", "Pu", f"{targets[0]}_df", f"{targets[1]}_df")
    return DataSet(name, structure, names, targets, X, np.column_stack(as_targets(plants.m, plants.n)), plants)


def _lags(where: str, rng: np.random.Generator, shape: tuple[int, ...]) -> Numbers:
    if where == GRID:
        return rng.choice(T_GRID, shape)
    return rng.uniform(*((20.0, 40.0) if where == OUT_OF_RANGE else (1.0, 20.0)), shape)


def _gain_and_dead_time(where: str, rng: np.random.Generator, count: int) -> tuple[Numbers, Numbers]:
    if where == GRID:
        return rng.integers(1, 16, count).astype(np.float64), rng.integers(1, 13, count).astype(np.float64)
    return rng.uniform(1.0, 15.0, count), rng.uniform(1.0, 12.0, count)


def _as_lags(m: Numbers, n: Numbers) -> tuple[Numbers, Numbers]:
    """Return the two lags; a pair that rounding makes ring is a double lag."""
    root = np.sqrt(np.maximum(n * n / 4.0 - m, 0.0))
    return n / 2.0 + root, n / 2.0 - root


def _cycles(plants: Plants) -> RelayBatch:
    return run_relay_tests(relay_tests(plants.K, plants.m, plants.n, plants.D, -H, H), switches=200)


def noisy_cycles(plants: Plants, cycle: RelayBatch, rng: np.random.Generator) -> tuple[Numbers, Numbers]:
    """Return amplitude and period of first-order oscillations under a relay that reads the noise, too."""
    records, sample_s, _ = noisy_records(plants, cycle, rng)
    filtered = band_passed(records.pv)
    switches = records.switches[-2 * PERIODS - 1 :]
    A, Pu = np.empty(plants.K.size), np.empty(plants.K.size)
    for i, (begin, end) in enumerate(zip(switches[0], switches[-1], strict=True)):
        wave = filtered[begin:end, i]
        whole = wave[: PERIODS * (wave.size // PERIODS)].reshape(PERIODS, -1)
        A[i] = (whole.max(axis=1) - whole.min(axis=1)).mean() / 2.0
        Pu[i] = (end - begin) / PERIODS * sample_s[i]
    return A, Pu


def noisy_records(plants: Plants, cycle: RelayBatch, rng: np.random.Generator) -> tuple[Records, Numbers, Numbers]:
    """Return sampled relay tests with noise in the loop, the sample interval of each (s), and its noise (PV)."""
    sample_s = cycle.period_s / PER_PERIOD
    half = np.arange(PER_PERIOD // 2) / PER_PERIOD * cycle.period_s[:, None]
    top, away = cycle.highest[:, None], plants.K[:, None] * H
    pv = away - (away + top) * np.exp(-half / plants.n[:, None])
    sigma = np.sqrt((pv**2).mean(axis=1)) * 10.0 ** (-DECIBELS / 20.0)
    one = np.ones(plants.K.size)
    processes = Processes(plants.K, one, plants.n / sample_s, 0.0 * one, plants.D / sample_s)
    relays = Relays(-H * one, H * one, ON_SIGMA * sigma, sigma)
    switches = 2 * (PERIODS + SETTLING) + 1
    return run(processes, relays, switches, PER_PERIOD * switches, rng), sample_s, sigma


def band_passed(pv: Numbers) -> Numbers:
    """Return noisy PVs, shape (N, B), through the band-pass, forward and backward."""
    corners = [2.0 * corner / PER_PERIOD for corner in BAND]
    filtered: Numbers = sosfiltfilt(butter(2, corners, "bandpass", output="sos"), pv, axis=0)
    return filtered


SETS: dict[str, Callable[[str, np.random.Generator], DataSet]] = {
    "fopdt": _fopdt,
    "fopdt_noise": _noisy_fopdt,
    "overdamped": _overdamped,
    "underdamped": _underdamped,
}
"""The data sets by name, in the order of the thesis."""
