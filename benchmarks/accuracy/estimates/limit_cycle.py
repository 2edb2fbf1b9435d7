"""Estimates from one measurement of the limit cycle: errors of describing function, closed form and learned correction.

    python benchmarks/accuracy/estimates/limit_cycle.py [--plants 8] [--half-periods 8]

Relay from rest, 100 samples a period, static gain given, dead time given to the describing function of second order.
For each structure and level of noise the median over the plants of a record's worst relative error of a parameter.
"""

from __future__ import annotations

import argparse
import math
import warnings

import numpy as np

from autotuner.core.identification.learned.correction import by_learned
from autotuner.core.identification.limit_cycle.from_cycle import Known, by_closed_form, by_describing_function
from autotuner.core.recording import Recording
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner_models.learned.artefacts import SHIPPED, load
from autotuner_sim import Fopdt, SopdtOverdamped, SopdtUnderdamped, SteppedPlant, find_limit_cycle, symmetric_relay

SEED, REST, PER_PERIOD, HIGH = 77, 50, 100, 1.5
DECIBELS = (math.inf, 40.0, 20.0)


def drawn(count):
    """Return plants of each structure, by name; nothing was trained on them."""
    rng = np.random.default_rng(SEED)

    def log_even(low, high):
        return 10.0 * math.exp(rng.uniform(math.log(low), math.log(high)))

    plants = {"fopdt": [], "sopdt_overdamped": [], "sopdt_underdamped": []}
    for _ in range(count):
        plants["fopdt"].append(Fopdt(1.5, 10.0, log_even(0.1, 5.0)))
        plants["sopdt_overdamped"].append(SopdtOverdamped(1.5, 10.0, 10.0 * rng.uniform(0.15, 0.9), log_even(0.1, 2.0)))
        plants["sopdt_underdamped"].append(
            SopdtUnderdamped(1.5, 100.0, 20.0 * rng.uniform(0.2, 0.9), log_even(0.2, 3.0))
        )
    return plants


def recorded(plant, half_periods, decibels, seed):
    """Return the record of a relay from rest, levels -1 and `HIGH`, with noise that the relay reads."""
    cycle = find_limit_cycle(plant, symmetric_relay())
    sigma = cycle.peak / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    dt, rng, device, rows = cycle.period_s / PER_PERIOD, np.random.default_rng(seed), SteppedPlant(plant), []
    is_high, switched = True, -1
    while switched < half_periods:
        k = len(rows)
        device.advance(k * dt)
        pv = device.pv + sigma * rng.standard_normal()
        was = is_high
        if k > REST and abs(pv) > 3.0 * sigma:
            is_high = pv < 0.0
        switched += is_high != was
        device.output = 0.0 if k < REST else HIGH if is_high else -1.0
        rows.append((k * dt, device.output, pv))
    return Recording(*np.array(rows).T, settings={"noise_sigma": sigma})


def worst(estimate, structure, plant):
    """Return the worst relative error of a parameter, NaN without a model of the structure."""
    if estimate.model is None or estimate.model.structure != structure:
        return math.nan
    return max(abs(value / getattr(plant, name) - 1.0) for name, value in estimate.model.parameters().items())


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plants", type=int, default=8)
    parser.add_argument("--half-periods", type=int, default=8)
    args = parser.parse_args()
    models = load(SHIPPED)
    print("| structure | noise | describing function | closed form | learned |\n|---|---|---|---|---|")
    for structure, plants in drawn(args.plants).items():
        for decibels in DECIBELS:
            errors = []
            for seed, plant in enumerate(plants):
                record = recorded(plant, args.half_periods, decibels, seed)
                cycle, gain = measure_limit_cycle(record), Known(plant.K, "given")
                estimates = (
                    by_describing_function(cycle, gain, plant, structure),
                    by_closed_form(cycle, gain, structure),
                    by_learned(record, structure, (plant.K, 0.0), models),
                )
                errors.append([worst(estimate, structure, plant) for estimate in estimates])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # none answered
                medians = np.nanmedian(errors, axis=0)
            print(
                f"| {structure} | {decibels:g} dB | " + " | ".join(f"{100.0 * m:.3g} %" for m in medians) + " |",
                flush=True,
            )


if __name__ == "__main__":
    main()
