"""When the experiment stops by itself: switches needed and errors made on first-order plants with noise.

    python benchmarks/accuracy/experiment/confidence_stop.py [--seeds 40]

D/T 0.3, 1 and 3, noise of 0.5 % of the span over which the PV swings. The experiment is run as the runtime runs it, the
running model after each half period included, and the record up to its stop is identified. Required of every plant,
exit code 1 otherwise: no run needs more than 5 switches, and the median errors of K and T are within 2 %, that of D
within 1 %.
"""

import argparse
import math
import sys

import numpy as np

from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner_sim import Fopdt
from benchmarks.accuracy.cases._plants import BatchPlant
from benchmarks.accuracy.experiment.noise import Loop, experiment, relay_part

RATIOS = (0.3, 1.0, 3.0)
LAG_S = 10.0
SHARE = 0.005
"""Noise as a share of the span of the PV."""
MOST_SWITCHES = 5
ALLOWED = {"K": 0.02, "T": 0.02, "D": 0.01}


def plant_of(ratio):
    dead_s = ratio * LAG_S
    return BatchPlant(f"D/T {ratio:g}", Fopdt(2.0, LAG_S, dead_s), min(dead_s / 20.0, LAG_S / 10.0))


def span_of(one):
    """Return the span of the PV in the undisturbed oscillation."""
    loop = Loop(one, 0.0, 0)
    rows = relay_part(loop, experiment(loop))
    return float(np.ptp([sample.pv for sample in rows[len(rows) // 2 :]]))


def perform(one, sigma, seed):
    """Return the switches and the relative errors, or None for a run without a model."""
    loop = Loop(one, sigma, seed + 1)
    run = experiment(loop)
    if run.verdict is not None:
        return None
    model = identify(Recording.from_samples(loop.samples, run.settings_so_far())).model
    if model is None or model.structure != "fopdt":
        return None
    switches = int(np.count_nonzero(np.diff([sample.output for sample in relay_part(loop, run)])))
    return switches, *(abs(getattr(model, name) / getattr(one.plant, name) - 1.0) for name in ALLOWED)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=40)
    options = parser.parse_args(arguments)
    missed = []
    print(f"{'plant':10} {'runs':>8} {'switches':>14} {'K %':>14} {'T %':>14} {'D %':>14}   median / worst")
    for one in map(plant_of, RATIOS):
        sigma = SHARE * span_of(one)
        done = [found for seed in range(options.seeds) if (found := perform(one, sigma, seed)) is not None]
        columns = np.array(done, float).reshape(-1, 1 + len(ALLOWED))
        medians, worst = np.median(columns, axis=0), columns.max(axis=0, initial=-math.inf)
        cells = [f"{medians[0]:.0f} / {worst[0]:.0f}"]
        cells += [f"{100.0 * m:.2f} / {100.0 * w:.2f}" for m, w in zip(medians[1:], worst[1:], strict=True)]
        print(f"{one.name:10} {len(done):4d}/{options.seeds:<4d}" + "".join(f"{cell:>15}" for cell in cells))
        missed += [f"{one.name}: a run without a first-order model"] * (len(done) < options.seeds)
        missed += [f"{one.name}: {worst[0]:.0f} switches"] * bool(worst[0] > MOST_SWITCHES)
        for (name, most), error in zip(ALLOWED.items(), medians[1:], strict=True):
            missed += [f"{one.name}: {name} {100.0 * error:.2f} %"] * bool(error > most)
    for line in missed:
        print(f"NOT MET  {line}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
