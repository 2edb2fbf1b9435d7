"""Relay tests of one plant or thousands, exact or by samples with noise.

    plants   K e^{-Ds}/(m s^2 + n s + 1),   m = 0 for a single lag

Each relay acts in the direction of its plant's gain and starts from rest, where the PV is 0: at its high level, or at
the low one where rest is beyond the first threshold. `kernel` does the computing, compiled where Numba is installed
(extra `train`) and some hundred times slower without. Nothing else of the simulator imports this module or Numba.

    tests = relay_tests(K=[1.0, 2.0], m=0.0, n=[10.0, 5.0], D=2.0, hysteresis=0.05)
    run_relay_tests(tests).period_s
    run_sampled_relay_tests(tests, rng.normal(size=20_000), 0.01, scale=0.02).period_s

`K` PV/output, `D`, `n`, times s, `m` s^2, levels in output units, `reference` and `hysteresis` PV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.relay import kernel

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from autotuner_sim.relay.run import Relay

Numbers = NDArray[np.float64]

LEAST_SWITCHES = 3
"""A full period lies between the first and the third of three switches."""


class RelayTests(NamedTuple):
    """Plants with their relays, one an element; see `relay_tests`."""

    K: Numbers
    m: Numbers
    n: Numbers
    D: Numbers
    low: Numbers
    high: Numbers
    reference: Numbers
    hysteresis: Numbers


def relay_tests(
    K: ArrayLike,
    m: ArrayLike,
    n: ArrayLike,
    D: ArrayLike,
    low: ArrayLike = -1.0,
    high: ArrayLike = 1.0,
    reference: ArrayLike = 0.0,
    hysteresis: ArrayLike = 0.0,
) -> RelayTests:
    """Return relay tests of numbers or arrays that broadcast together.

    Raises
    ------
    ValueError
        A value is not finite, a gain 0, `n` not positive, `m`, `D` or a dead zone negative, or a high level not above
        the low one.
    """
    columns = np.broadcast_arrays(K, m, n, D, low, high, reference, hysteresis)
    tests = RelayTests(*(np.array(column, dtype=np.float64).ravel() for column in columns))
    _require(np.isfinite(tests).all(), "every value of a relay test must be finite")
    _require((tests.K != 0.0).all(), "K must not be 0")
    _require((tests.n > 0.0).all(), "n must be positive: the plant must be stable")
    _require((np.array([tests.m, tests.D, tests.hysteresis]) >= 0.0).all(), "m, D, hysteresis must not be negative")
    _require((tests.low < tests.high).all(), "high must exceed low")
    return tests


def relay_test(plant: Fopdt | SopdtOverdamped | SopdtUnderdamped, relay: Relay) -> RelayTests:
    """Return the test of one plant.

    Raises
    ------
    ValueError
        The relay acts against the direction of the plant's gain.
    """
    _require(relay.direct == (plant.K > 0.0), f"relay.direct must be {plant.K > 0.0} for a gain K = {plant.K}")
    m, n = coefficients(plant)
    return relay_tests(plant.K, m, n, plant.D, relay.low, relay.high, relay.reference, relay.hysteresis)


def coefficients(plant: Fopdt | SopdtOverdamped | SopdtUnderdamped) -> tuple[float, float]:
    """Return `m`, s^2, and `n`, s."""
    if isinstance(plant, SopdtUnderdamped):
        return plant.m, plant.n
    if isinstance(plant, Fopdt):
        return 0.0, plant.T
    return plant.T1 * plant.T2, plant.T1 + plant.T2


@dataclass(frozen=True, slots=True, eq=False)
class RelayBatch:
    """Relay tests that have been run.

    Attributes
    ----------
    tests : RelayTests
        What was tested.
    switches_s : array of float, shape (N, switches)
        Times of the switches, s from the start; NaN where a test has no more.
    starts_high : array of bool, shape (N,)
        The first position.
    lowest, highest : array of float, shape (N,)
        Extremes of the PV, without noise, over the last full period; NaN where a test lacks switches.
    turns_once : array of bool, shape (N,)
        Whether the PV has never turned between a switch and its arrival at the plant; False where a test lacks
        switches.
    """

    tests: RelayTests
    switches_s: Numbers
    starts_high: NDArray[np.bool_]
    lowest: Numbers
    highest: Numbers
    turns_once: NDArray[np.bool_]

    @property
    def period_s(self) -> Numbers:
        """Length of the last full period, s, shape (N,)."""
        period_s: Numbers = self.switches_s[:, -1] - self.switches_s[:, -3]
        return period_s

    @property
    def high_s(self) -> Numbers:
        """Time at the high level in the last full period, s, shape (N,)."""
        halves = np.diff(self.switches_s[:, -3:])
        ends_high = self.starts_high == (self.switches_s.shape[1] % 2 == 1)
        high_s: Numbers = np.where(ends_high, halves[:, 1], halves[:, 0])
        return high_s

    @property
    def low_s(self) -> Numbers:
        """Time at the low level in the last full period, s, shape (N,)."""
        return self.period_s - self.high_s

    @property
    def peak(self) -> Numbers:
        """Amplitude of the PV over the last full period, zero to peak, shape (N,)."""
        return (self.highest - self.lowest) / 2.0

    @property
    def fundamental(self) -> Numbers:
        """Amplitude of the PV's fundamental once the test has settled: `|G(jw)|` times that of the relay."""
        tests, w = self.tests, 2.0 * math.pi / self.period_s
        gain = np.abs(tests.K) / np.hypot(1.0 - tests.m * w * w, tests.n * w)
        fundamental: Numbers = gain * (tests.high - tests.low) * 2.0 / math.pi * np.sin(w * self.high_s / 2.0)
        return fundamental


def run_relay_tests(tests: RelayTests, switches: int = 20) -> RelayBatch:
    """Run relay tests with exact switches.

    Parameters
    ----------
    tests : RelayTests
        Plants and relays.
    switches : int
        Switches of each test, 3 at least. A test whose PV does not oscillate has fewer, and one without dead time and
        dead zone has none.
    """
    _require(switches >= LEAST_SWITCHES, f"switches must be {LEAST_SWITCHES} or more, not {switches}")
    size = tests.K.size
    times_s, extremes, once = np.full((size, switches + 1), math.nan), *_empty_results(size)
    kernel.run_exact(np.stack(tests, axis=1), times_s, extremes, once)
    return RelayBatch(tests, times_s[:, 1:], _starts_high(tests, np.zeros(size)), extremes[:, 0], extremes[:, 1], once)


def run_sampled_relay_tests(
    tests: RelayTests,
    noise: ArrayLike,
    sample_time_s: float,
    *,
    scale: ArrayLike = 1.0,
    starts: ArrayLike = 0,
    switches: int = 20,
) -> RelayBatch:
    """Run relay tests whose relays see samples of the PV with noise.

        reading_i = y(i dt) + scale e_{starts + i}

    A relay switches at a sample whose reading is beyond its threshold. Between two arrivals of its output the PV moves
    exactly. A test ends when it has read all the noise, which goes round.

    Parameters
    ----------
    tests : RelayTests
        Plants and relays.
    noise : array of float, shape (M,)
        Noise, sample by sample, for all tests.
    sample_time_s : float
        From one sample to the next, s.
    scale : float or array of shape (N,), optional
        What the noise of each test is multiplied with; PV, if the noise has standard deviation 1.
    starts : int or array of shape (N,), optional
        Element of the noise that each test reads first.
    switches : int, optional
        Switches of each test, 3 at least.

    Raises
    ------
    ValueError
        The noise is not finite, the sample time not positive, or there are fewer than 3 switches.
    """
    row = np.asarray(noise, dtype=np.float64)
    _require(row.ndim == 1 and row.size > 0 and np.isfinite(row).all(), "noise must be a row of finite numbers")
    _require(0.0 < sample_time_s < math.inf, f"sample_time_s must be positive, not {sample_time_s}")
    _require(switches >= LEAST_SWITCHES, f"switches must be {LEAST_SWITCHES} or more, not {switches}")
    size = tests.K.size
    scales = np.array(np.broadcast_to(scale, size), dtype=np.float64)
    first = np.array(np.broadcast_to(starts, size), dtype=np.int64) % row.size
    samples, extremes, once = np.full((size, switches + 1), -1), *_empty_results(size)
    kernel.run_sampled(np.stack(tests, axis=1), row, scales, first, sample_time_s, samples, extremes, once)
    times_s = np.where(samples < 0, math.nan, samples * sample_time_s)[:, 1:]
    return RelayBatch(tests, times_s, _starts_high(tests, scales * row[first]), extremes[:, 0], extremes[:, 1], once)


def _empty_results(size: int) -> tuple[Numbers, NDArray[np.bool_]]:
    return np.full((size, 2), math.nan), np.zeros(size, dtype=np.bool_)


def _starts_high(tests: RelayTests, readings: Numbers) -> NDArray[np.bool_]:
    way = np.sign(tests.K)
    starts_high: NDArray[np.bool_] = way * (readings - (tests.reference + way * tests.hysteresis)) <= 0.0
    return starts_high


def _require(holds: object, message: str) -> None:
    if not holds:
        raise ValueError(f"{message}.")
