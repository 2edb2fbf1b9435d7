"""Recordings of the simulator with hidden physics, without noise, and models of them at the true numbers.

What such a model leaves of its record is the error of its simulation alone, and the sizes that are solved for are those
of the simulator's settings.
"""

from __future__ import annotations

import math

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.structures import FOPDT, INTEGRATING, SECOND_ORDER, THIRD_ORDER
from autotuner.core.recording import Recording
from autotuner_sim import Fopdt, Integrating, LagChain, SopdtOverdamped, SopdtUnderdamped, SteppedPlant

OUTPUT0, PV0 = 40.0, 100.0
LAG = Fopdt(2.0, 12.0, 3.0)
PAIR = SopdtOverdamped(1.5, 20.0, 8.0, 5.0)
RINGING = SopdtUnderdamped(1.2, 60.0, 6.0, 4.0)
INTEGRATOR = Integrating(0.05, 6.0, 2.0)


def moves(count=300, hold=15, size=8.0, seed=2):
    """Return an output that stands at one of four levels for `hold` samples each, as deviation from its start."""
    random = np.random.default_rng(seed)
    output = np.repeat(random.choice([-1.0, -0.5, 0.5, 1.0], count // hold), hold) * size
    output[:hold] = 0.0
    output[hold : 3 * hold] = np.repeat([size, -size], hold)  # the whole swing
    return output


def record(plant, output, sample_s=1.0, **physics):
    """Return what the simulator's plant with some physics makes of an output."""
    stepped = SteppedPlant(plant, output0=OUTPUT0, pv0=PV0, **physics)
    t, pv = sample_s * np.arange(len(output)), []
    for at, u in zip(t.tolist(), output, strict=True):
        stepped.advance(at)
        pv.append(stepped.measure())
        stepped.output = OUTPUT0 + float(u)
    return Recording(t, OUTPUT0 + np.array(output), np.array(pv))


def structure_of(plant):
    """Return the structure that the tuner has for a plant, and its shape."""
    if isinstance(plant, Fopdt):
        return FOPDT, [plant.T]
    if isinstance(plant, Integrating):
        return INTEGRATING, [plant.T]
    if isinstance(plant, LagChain):
        one, two, third = plant.lags
        return THIRD_ORDER, [one + two, one * two / (one + two), third]
    n, m = (plant.n, plant.m) if hasattr(plant, "n") else (plant.T1 + plant.T2, plant.T1 * plant.T2)
    return SECOND_ORDER, [n, m / n]


def at_the_truth(recording, plant, *effects, dataset=None, background=("offset",)):
    """Return the plant's model with effects, each with its searched numbers, where only sizes are solved for.

    Parameters
    ----------
    recording : Recording
        The record.
    plant : object
        The simulator's plant.
    *effects : tuple
        Effect and the values of what it searches for.
    dataset : Dataset, optional
        The record made ready.
    background : tuple of str
        What the PV does besides.
    """
    dataset = dataset_of(recording) if dataset is None else dataset
    structure, shape = structure_of(plant)
    rows = np.arange(dataset.data.t.size)
    problem = Extended(dataset, structure, tuple(effect for effect, _ in effects), rows, background)
    numbers = [number for _, p in effects for number in p]
    theta = np.array([*(math.log(s) for s in shape), plant.D / problem.unit_s, *numbers])
    columns, counts = problem.columns(theta, rows)
    linear = np.linalg.lstsq(columns, dataset.data.pv, rcond=None)[0]
    return Fitted(problem, theta, linear, counts, dataset.data.pv - columns @ linear)


def left(fitted):
    """Return what a model leaves of the PV, as a share of its motion."""
    return fitted.rms / float(np.std(fitted.problem.dataset.data.pv))


def of_form(effects, key):
    """Return the one effect of a name and form."""
    (found,) = (effect for effect in effects if effect.key == key)
    return found
