"""The tests that the literature's methods ask for, made on the thesis's processes: every method sees the same records.

    symmetric   ideal relay +-1 about rest        hysteresis   the same with a dead zone of a tenth of the amplitude
    biased      relay -1, 2                       delayed      symmetric, with more dead time in the loop
    step        from 0 to 1                       beside       symmetric, beside a PI controller (Ziegler and Nichols)

sampled 500 times a period, from rest. With noise, it is white, 20 dB under the mean square of the symmetric oscillation
and on the PV that the relay sees, and every relay has a dead zone of three standard deviations at least.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design import UltimatePoint, apply_rule
from autotuner.core.experiment.parallel_controller import Parallel
from autotuner.core.recording import Recording, Sample
from autotuner_models.learned.experiments import ON_SIGMA
from autotuner_models.literature import Trial
from autotuner_models.literature.trial import BESIDE, BIASED, DELAYED, HYSTERESIS, STEP, SYMMETRIC
from autotuner_sim import PLANTS, SteppedPlant, find_limit_cycle, symmetric_relay

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner_sim import Plant

PER_PERIOD = 500
"""Samples in a period: enough to make the sampling error negligible."""
REST_SAMPLES = 30
"""Samples at rest before the relay begins."""
SWITCHES = 15
"""Switches of a trial: seven periods, of which the last are steady."""
ADDED_DELAY = 0.15
"""Extra dead time of the second relay test, in periods."""
DEAD_ZONE = 0.1
"""Dead zone of the test with hysteresis, half width, in amplitudes."""
SETTLED = 8.0
"""Length of the step test, in sums of all times of the process."""


def trial_of(structure: str, truth: Mapping[str, float], decibels: float | None = None, seed: int = 0) -> Trial:
    """Return the trial of a process.

    Parameters
    ----------
    structure, truth
        The process.
    decibels : float, optional
        By how much the noise is below the oscillation; none by default.
    seed : int
        Of the noise.
    """
    plant = PLANTS[structure](**truth)
    cycle = find_limit_cycle(plant, symmetric_relay())
    sigma = 0.0 if decibels is None else cycle.peak / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    dt, added = cycle.period_s / PER_PERIOD, ADDED_DELAY * cycle.period_s
    zone, later = ON_SIGMA * sigma, PLANTS[structure](**{**truth, "D": truth["D"] + added})
    length_s = SETTLED * sum(math.sqrt(v) if name == "m" else v for name, v in truth.items() if name != "K")
    rng = np.random.default_rng(seed)
    ultimate = UltimatePoint(4.0 / (math.pi * cycle.peak), cycle.period_s)
    controller = apply_rule("ziegler_nichols_pi", ultimate=ultimate).gains
    tests = {
        SYMMETRIC: _relay_test(plant, dt, sigma, rng, (-1.0, 1.0), zone),
        HYSTERESIS: _relay_test(plant, dt, sigma, rng, (-1.0, 1.0), max(zone, DEAD_ZONE * cycle.peak)),
        BIASED: _relay_test(plant, dt, sigma, rng, (-1.0, 2.0), zone),
        DELAYED: _relay_test(later, dt, sigma, rng, (-1.0, 1.0), zone),
        STEP: _recorded(plant, dt, sigma, rng, round(length_s / dt), lambda k, _: float(k >= REST_SAMPLES)),
        BESIDE: _relay_test(plant, dt, sigma, rng, (-1.0, 1.0), zone, controller),
    }
    return Trial(structure, truth["K"], truth["D"], tests, added, controller)


def _relay_test(
    plant: Plant,
    dt: float,
    sigma: float,
    rng: np.random.Generator,
    levels: tuple[float, float],
    zone: float,
    controller: PidGains | None = None,
) -> Recording:
    is_high, switched = True, 0

    def output(k: int, pv: float) -> float | None:
        nonlocal is_high, switched
        if k < REST_SAMPLES:
            return 0.0
        was = is_high
        if k > REST_SAMPLES and abs(pv) > zone:
            is_high = pv < 0.0
        switched += is_high != was
        return None if switched > SWITCHES else levels[is_high]

    return _recorded(plant, dt, sigma, rng, 100 * SWITCHES * PER_PERIOD, output, controller)


def _recorded(
    plant: Plant,
    dt: float,
    sigma: float,
    rng: np.random.Generator,
    samples: int,
    output: Callable[[int, float], float | None],
    controller: PidGains | None = None,
) -> Recording:
    """Drive a plant from rest, sample by sample, until the output is None; a controller adds its part, unrecorded."""
    device, rows = SteppedPlant(plant), []
    beside = None if controller is None else Parallel(controller, 0.0, (-math.inf, math.inf))
    for k in range(samples):
        device.advance(k * dt)
        pv = device.pv + sigma * float(rng.standard_normal())
        commanded = output(k, pv)
        if commanded is None:
            break
        sample = Sample(k * dt, pv, commanded)
        device.output = commanded if beside is None else beside.step(sample, commanded, resting=k < REST_SAMPLES)
        rows.append((k * dt, commanded, pv))
    return Recording(*np.array(rows).T)
