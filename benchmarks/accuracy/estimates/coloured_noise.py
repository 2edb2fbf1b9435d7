"""Identification under noise that is not white, against the truth and the Cramer-Rao bound for that very noise.

    python benchmarks/accuracy/estimates/coloured_noise.py [--samples N ...] [--decibels DB] [--seeds N]

The twelve plants and records of five switches of `identification.py noise`, 100 samples a period, but each sample of
the noise remembers the ones before: it is correlated over 3, 10 and 30 samples (`e^{-1/samples}` of the one before).
The structure is given; each record is identified by plain least squares, whose intervals are widened by what the
residual's correlation makes of its samples, and by what the program answers, which reckons with the noise's memory
where that explains the residual. "error / bound" is the root mean square error over the bound, for parameters whose
bound is under 10 %; the worst of a parameter is the worst plant's.
"""

import argparse
import math

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.estimation.data import GainPrior, data_of
from autotuner.core.estimation.prewhitening import remembered
from autotuner.core.identification.selection import EXACT, choose
from benchmarks.accuracy.cases.five_switches import cramer_rao, parameters, period_of, record
from benchmarks.accuracy.estimates.identification import PER_PERIOD, PLANTS, TELLING, noise_of

SHOW = Console(width=150)
WAYS = ("plain least squares", "with the noise's memory")


def trial(plant, memory, decibels, seed):
    """Return, for both ways, misses, whether the intervals held, and the bound; the last is whether the memory was."""
    dt = period_of(plant) / PER_PERIOD
    sigma = noise_of(plant, dt, decibels)
    noisy = record(plant, dt, sigma, seed, 3.0 * sigma, memory=memory)
    data, prior = data_of(noisy), GainPrior(None, 1)
    plain = choose(data, plant.structure, prior, moments=EXACT).best
    better = remembered(plain, data, prior)
    bound, truth = cramer_rao(plant, noisy, sigma, memory), parameters(plant)
    return [judged(candidate, truth) for candidate in (plain, better or plain)], bound, better is not None


def judged(candidate, truth):
    found, intervals = candidate.model.parameters(), candidate.uncertainty().interval95
    misses = [found[name] - value for name, value in truth.items()]
    return misses, [intervals[name][0] <= value <= intervals[name][1] for name, value in truth.items()]


def of_plant(plant, memory, decibels, seeds):
    """Return, for both ways, errors over bounds and whether the intervals held; and how often the memory was taken."""
    trials = [trial(plant, memory, decibels, seed) for seed in range(seeds)]
    bound = np.sqrt(np.mean([bound**2 for _, bound, _ in trials], axis=0))
    telling = bound < TELLING * np.abs(np.array(list(parameters(plant).values())))
    ways = []
    for way in range(len(WAYS)):
        misses, held = (np.array([ways[way][part] for ways, _, _ in trials])[:, telling] for part in range(2))
        ways.append((np.sqrt(np.mean(misses**2, axis=0)) / bound[telling], held))
    return ways, np.mean([taken for _, _, taken in trials])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=float, nargs="+", default=(3.0, 10.0, 30.0), help="over which noise lasts")
    parser.add_argument("--decibels", type=float, default=30.0, help="of the oscillation over the noise (30)")
    parser.add_argument("--seeds", type=int, default=40, help="records of each plant (40)")
    args = parser.parse_args()
    table = Table(title=f"{args.decibels:g} dB, {args.seeds} records of each of {len(PLANTS)} plants")
    for title in ("noise lasts", "way", "error / bound, median", "worst", "intervals hold, pooled", "worst plant"):
        table.add_column(title)
    table.add_column("memory taken")
    for samples in args.samples:
        plants = [of_plant(plant, math.exp(-1.0 / samples), args.decibels, args.seeds) for plant in PLANTS]
        for way, name in enumerate(WAYS):
            ratios = np.concatenate([ways[way][0] for ways, _ in plants])
            held = [ways[way][1] for ways, _ in plants]
            pooled, worst = np.mean(np.concatenate([part.ravel() for part in held])), min(part.mean() for part in held)
            cells = f"{np.median(ratios):.2f}", f"{ratios.max():.2f}", f"{pooled:.1%}", f"{worst:.1%}"
            taken = f"{np.mean([taken for _, taken in plants]):.0%}" if way else ""
            table.add_row(f"{samples:g} samples", name, *cells, taken)
    SHOW.print(table)


if __name__ == "__main__":
    main()
