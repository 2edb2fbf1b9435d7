"""Outputs that changed between two samples: error of K, T and D with the moments as recorded, and estimated.

    python benchmarks/accuracy/estimates/moments.py [--seeds N]

An exact relay test (levels -1 and 2) of five switches on a first-order process, sampled afterwards at a random phase:
15 samples a dead time up to D/T 0.3, 30 above. `auto` lets the record decide, `exact` takes the moments as recorded,
`between` as estimated. Medians and 90 % quantiles over the seeds; the last column is how often the 95 % intervals of K
and T hold the truth.
"""

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner_sim import Fopdt, Relay, run_relay

RATIOS = (0.1, 0.15, 0.3, 1.0, 2.0, 5.0)
SIGMAS = (0.0, 0.01)
REST, SWITCHES = 30, 5
NAMES = ("K", "T", "D")
SHOW = Console(width=150)


def sampled(plant, dt, sigma, seed):
    """Return the record of one test; `sigma` in spans of the PV."""
    rng = np.random.default_rng(seed)
    run = run_relay(plant, Relay(-1.0, 2.0), 1e9, max_switches=SWITCHES + 1)
    end_s = run.times_s[-1] - 0.3 * (run.times_s[-1] - run.times_s[-2])
    t = (np.arange(-REST, int(end_s / dt)) + rng.random()) * dt
    pv = run.pv(t)
    return Recording(t, run.output(t), pv + sigma * np.ptp(pv) * rng.standard_normal(t.size))


def misses(plant, dt, sigma, moments, seeds):
    """Return relative errors, percent, one row a seed, and how often the intervals of K and T hold."""
    rows, held = [], []
    for seed in range(seeds):
        estimate = identify(sampled(plant, dt, sigma, seed), "fopdt", moments=moments).estimates["least_squares"]
        if estimate.model is None:
            rows.append([np.inf] * 3)
            continue
        found = estimate.model.parameters()
        rows.append([100.0 * abs(found[name] / getattr(plant, name) - 1.0) for name in NAMES])
        held += [low <= getattr(plant, name) <= high for name in "KT" for low, high in [estimate.interval95[name]]]
    return np.array(rows), float(np.mean(held))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    table = Table(title=f"error in percent, {args.seeds} seeds: K T D", title_justify="left")
    for title in ("D/T", "noise % of span", "moments", "median", "90 % quantile", "intervals hold %"):
        table.add_column(title)
    for ratio in RATIOS:
        plant = Fopdt(1.0, 10.0, 10.0 * ratio)
        dt = plant.D / (15.0 if ratio < 1.0 else 30.0)
        for sigma in SIGMAS:
            for moments in ("exact", "auto", "between"):
                errors, held = misses(plant, dt, sigma, moments, args.seeds)
                cells = (np.median(errors, axis=0), np.quantile(errors, 0.9, axis=0))
                texts = (" ".join(f"{value:.2g}" for value in cell) for cell in cells)
                table.add_row(f"{ratio:g}", f"{100 * sigma:g}", moments, *texts, f"{100 * held:.0f}")
    SHOW.print(table)


if __name__ == "__main__":
    main()
