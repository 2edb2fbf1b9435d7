"""One short relay test, sample by sample: rest, five switches of an asymmetric relay, a last stretch."""

import math

import numpy as np

from autotuner.core.estimation.simulation import response
from autotuner.core.model.process import STRUCTURES
from autotuner.core.recording import Recording
from autotuner_sim import Fopdt, Integrating, Relay, SopdtOverdamped, SopdtUnderdamped, run_relay
from autotuner_sim.stepped import SteppedPlant

LOW, HIGH = -1.0, 2.0
QUIET, SWITCHES, TAIL = 30, 5, 0.3


def period_of(plant):
    """Return the period that the noise-free relay settles to, s."""
    run = run_relay(plant, Relay(LOW, HIGH, direct=plant.K > 0.0), 1e9, max_switches=SWITCHES + 1)
    return 2.0 * float(np.median(np.diff(run.times_s)[1:]))


def noise(rng, memory):
    """Yield noise of deviation 1, without end: each sample is `memory` times the one before, and something new."""
    value = rng.standard_normal()
    while True:
        yield value
        value = memory * value + math.sqrt(1.0 - memory**2) * rng.standard_normal()


def record(plant, dt, sigma=0.0, seed=0, hysteresis=0.0, low=LOW, high=HIGH, memory=0.0):
    """Return the recording of such a test, with noise on the PV that the relay sees too, white without memory."""
    device, rows = SteppedPlant(plant), []
    noises = noise(np.random.default_rng(seed), memory)
    is_high, switched = True, []
    while True:
        k = len(rows)
        device.advance(k * dt)
        pv = device.pv + sigma * next(noises)
        error = math.copysign(pv, pv * plant.K)
        was = is_high
        if k > QUIET and abs(error) > hysteresis:
            is_high = error < 0.0
        switched += [k] if is_high != was else []
        if len(switched) >= SWITCHES and k > switched[-1] + TAIL * (switched[-1] - QUIET) / SWITCHES:
            return Recording(*np.array(rows).T)
        output = 0.0 if k < QUIET else high if is_high else low
        device.output = output
        rows.append((k * dt, output, pv))


def parameters(plant):
    """Return the plant's parameters by name; a lag of 0 is none."""
    names = STRUCTURES[plant.structure].__slots__
    return {name: getattr(plant, name) for name in names if name in {"K", "D"} or getattr(plant, name) > 0.0}


def cramer_rao(plant, recording, sigma, memory=0.0):
    """Return the standard deviations that no unbiased estimator beats, the offset unknown, the noise as in `noise`."""
    truth, kind = parameters(plant), STRUCTURES[plant.structure]
    whole = {name: getattr(plant, name) for name in kind.__slots__}
    t, u = recording.t - recording.t[0], recording.output - recording.output[0]
    columns = [np.ones_like(t)]
    for name, value in truth.items():
        up, down = (response(kind(**{**whole, name: value * (1.0 + step)}), t, u) for step in (1e-6, -1e-6))
        columns.append((up - down) / (2e-6 * value))
    J = np.column_stack(columns)
    J[1:] = (J[1:] - memory * J[:-1]) / math.sqrt(1.0 - memory**2)
    scale = np.linalg.norm(J, axis=0)
    return sigma * np.sqrt(np.diag(np.linalg.inv((J / scale).T @ (J / scale))))[1:] / scale[1:]


def random_plant(rng):
    """Return a plant of any structure: D/T 0.05 to 10, K 0.1 to 15, time scale 10 ms to 5 h, damping 0.2 to 3."""

    def log_uniform(low, high):
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    K, T, d = log_uniform(0.1, 15.0), log_uniform(0.01, 18_000.0), log_uniform(0.05, 10.0)
    kind = rng.integers(5)
    if kind == 0:
        return Fopdt(K, T, d * T)
    if kind == 1:
        return Integrating(K, T if rng.random() < 0.5 else 0.0, d * T)
    z = log_uniform(0.2, 1.0) if kind == 2 else log_uniform(1.0, 3.0)
    if z < 1.0:
        return SopdtUnderdamped(K, T * T, 2.0 * z * T, d * T)
    T1 = T * (z + math.sqrt(z * z - 1.0))
    return SopdtOverdamped(K, T1, T * T / T1, d * T)
