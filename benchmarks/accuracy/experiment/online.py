"""What a relay beside a running controller tells: bias and honesty of least squares, bias of the describing function.

Each row is 40 experiments on K 1, T 10 s, D 2 s, sampled at 0.1 s, with white noise on the PV that the controller feeds
back. The record is fitted up to the end of the staircase. `bias` is the mean error over its own standard error: within
+-3 there is none to be seen. `covered` is the share of the 95 % intervals that hold the truth. The last columns are the
describing function's mean errors, static gain given, on the relay part.

    python benchmarks/accuracy/experiment/online.py
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.design import PidGains
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.identification import identify
from autotuner.core.recording import Recording, Sample
from autotuner_sim import Fopdt, Noise, SteppedPlant

TRUTH = {"K": 1.0, "T": 10.0, "D": 2.0}
SEEDS = 40
NOISES = (0.02, 0.05, 0.15)
"""Standard deviations, PV units; the oscillation swings by some 2.5."""
CONTROLLERS = {
    "none": None,
    "P": PidGains(3.512),
    "PI": PidGains(3.161, 6.11),
    "PID": PidGains(4.215, 3.666, 0.9165, 0.09165),
}
"""Ziegler and Nichols' rules on the relay test of this process."""
INTERVAL_S = 0.1


def record(gains: PidGains | None, noise: float, seed: int) -> Recording | None:
    """Return the record of an experiment, or None when it was refused."""
    plant = SteppedPlant(Fopdt(**TRUTH), output0=40.0, pv0=80.0, sensors=[Noise(noise, seed=seed)])
    experiment = Experiment(ExperimentSettings(sample_time_s=INTERVAL_S, amplitude=10.0, online=gains), 40.0)
    samples, output = [], 40.0
    while True:
        t = len(samples) * INTERVAL_S
        plant.advance(t)
        pv = plant.measure()
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            seen = experiment.settings_so_far()
            return None if experiment.verdict else Recording.from_samples(samples, seen)
        plant.output = output = command.output
        samples.append(Sample(t, pv, output))


def row(gains: PidGains | None, noise: float) -> list[str]:
    """Return the cells of one row."""
    fits, functions = [], []
    for seed in range(SEEDS):
        recording = record(gains, noise, seed)
        if recording is None:
            continue
        segments: Any = recording.settings["segments"]
        fits.append(identify(recording.window(0.0, segments["tail"]), "fopdt").estimates["least_squares"])
        relay = identify(recording.window(0.0, segments["half_relay"]), "fopdt", TRUTH["K"])
        functions.append(relay.estimates["describing_function"].model)
    cells = [f"{len(fits)}"]
    for name, truth in TRUTH.items():
        values = np.array([fit.model.parameters()[name] for fit in fits]) / truth - 1.0
        spread = values.std(ddof=1)
        within = [fit.interval95[name][0] <= truth <= fit.interval95[name][1] for fit in fits]
        bias = values.mean() / (spread / math.sqrt(values.size))
        cells.append(f"{100.0 * spread:.2f} % {bias:+.1f} {100.0 * np.mean(within):.0f} %")
    for name in ("T", "D"):
        known = [model.parameters()[name] / TRUTH[name] - 1.0 for model in functions if model is not None]
        cells.append(f"{100.0 * np.mean(known):+.1f} %" if known else "")
    return cells


def main() -> None:
    """Print the table."""
    table = Table(title="Least squares: spread, bias, covered; describing function: mean error")
    for heading in ("controller", "noise", "runs", "K", "T", "D", "DF T", "DF D"):
        table.add_column(heading, justify="right")
    for name, gains in CONTROLLERS.items():
        for noise in NOISES:
            table.add_row(name, f"{noise:g}", *row(gains, noise))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
