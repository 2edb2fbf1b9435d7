"""A relay experiment of the product on any process of the batch, moved exactly from sample to sample."""

import math

import numpy as np
from scipy.linalg import expm

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Recording, Sample

SAMPLES_PER_PERIOD = 100
LONGEST_PERIODS = 400


class HeldProcess:
    """A process of the batch under inputs that are held from sample to sample; dead time exact."""

    def __init__(self, process, h):
        A, B, C = state_space(process)
        whole = math.floor(process.D / h + 1e-9)
        rest = max(0.0, process.D - whole * h)
        self.moves = held(A, B, rest), held(A, B, h - rest)
        self.C, self.x, self.inputs = C, np.zeros(B.size), [0.0] * (whole + 2)

    def advance(self, u):
        self.inputs = [*self.inputs[1:], u]
        for (phi, gamma), value in zip(self.moves, self.inputs[:2], strict=True):
            self.x = phi @ self.x + gamma * value

    @property
    def pv(self):
        return float(self.C @ self.x)


def state_space(process):
    """Return `A`, `B`, `C` of the factors in a row, each fed by the one before."""
    A, B, value, slope = np.zeros((0, 0)), np.zeros(0), np.zeros(0), None
    feed = 1.0
    for factor in process.denominator:
        coefficients = list(factor)
        while coefficients[-1] == 0.0:
            coefficients.pop()
        order = len(coefficients) - 1
        if order == 0:
            continue
        n = B.size
        grown = np.zeros((n + order, n + order))
        grown[:n, :n] = A
        row = np.zeros(n + order)
        row[:n] = value
        row[n:] = -np.array(coefficients[:-1])
        grown[n + order - 1] = row / coefficients[-1]
        for i in range(order - 1):
            grown[n + i, n + i + 1] = 1.0
        A, B = grown, np.concatenate((B, np.zeros(order)))
        B[-1] = feed / coefficients[-1]
        feed = 0.0
        value = np.zeros(n + order)
        value[n] = 1.0
        slope = A[n] if order == 1 else np.eye(n + order)[n + 1]
    C = process.gain * value
    for zero in process.numerator:
        C = C + process.gain * zero[1] * slope
    return A, B, C


def held(A, B, h):
    n = B.size
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n] = A * h, B * h
    whole = expm(augmented)
    return whole[:n, :n], whole[:n, n]


def relay_record(process, Ku, Pu, sigma, seed):
    """Return the recording of the product's own experiment on the process, with white noise, or the refusal.

    Without noise the dead zone is 2 % of the oscillation to be expected, as a user would set it; else it follows from
    the noise.
    """
    h = Pu / SAMPLES_PER_PERIOD
    settings = ExperimentSettings(
        sample_time_s=h,
        limits=Limits(output=(-10.0, 10.0)),
        amplitude=1.0,
        hysteresis=None if sigma else 0.02 * 4.0 / (math.pi * Ku),
        response_limit_s=50.0 * Pu,
        time_limit_s=LONGEST_PERIODS * Pu,
    )
    experiment, plant, rng = Experiment(settings, 0.0), HeldProcess(process, h), np.random.default_rng(seed)
    samples, output = [], 0.0
    for k in range(LONGEST_PERIODS * SAMPLES_PER_PERIOD):
        pv = plant.pv + sigma * rng.standard_normal()
        command = experiment.step(Sample(k * h, pv, output))
        output = command.output
        samples.append(Sample(k * h, pv, output))
        if command.phase is Phase.RESTORE:
            break
        plant.advance(output)
    if experiment.verdict is not None:
        return None, experiment.verdict
    return Recording.from_samples(samples, experiment.settings_so_far()), None


def oscillation_rms(recording):
    """Return the root mean square of the PV's oscillation in the second half of the relay part."""
    segments = recording.settings["segments"]
    end = segments.get("half_relay", float(recording.t[-1]))
    begin = (segments["relay"] + end) / 2.0
    part = recording.pv[(recording.t >= begin) & (recording.t < end)]
    return float(np.std(part))
