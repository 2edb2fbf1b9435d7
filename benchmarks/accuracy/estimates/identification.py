"""Identification against the truth and against the Cramer-Rao bound, on records of five switches.

    python benchmarks/accuracy/estimates/identification.py [exact] [cycles] [noise] [profile] [structures] [record]
                                                           [speed]
                                                 [degenerate] [--plants N] [--seeds N] [--decibels DB ...]

exact       noise-free records of random plants: right structure, worst parameter error
cycles      exact symmetric limit cycles of random plants, K given: worst parameter error of the closed forms
noise       12 plants at 40, 30 and 20 dB under the mean square of the oscillation: error over the bound, and how often
            the 95 % intervals hold the truth
profile     steps that have not settled: how often the interval of the covariance holds the truth, and that
            of the profile likelihood, which takes its place where it differs
structures  the same plants and noise, the structure not given: how often it is found, or named as fitting as well
record      D/T 0.3, 1 and 3 with noise of 0.5 % of the PV's span, and the overdamped plant 60/15/5 s without noise
speed       processor times (of one thread), beside one `scipy.signal.lsim` of the same record
degenerate  records that show little or nothing

All seeds are fixed. Without a name all are run; 200 seeds of `noise` take about ten minutes, of `structures` more.
"""

import argparse
import cmath
import math
import resource
import time

import numpy as np
import scipy.signal
from rich.console import Console
from rich.table import Table

from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.least_squares import fit
from autotuner.core.estimation.simulation import response
from autotuner.core.identification import LimitCycle, identify
from autotuner.core.identification.limit_cycle.inverse_cycle import integrating_of_cycle, sopdt_of_cycle
from autotuner.core.model.process import STRUCTURES
from autotuner.core.model.structures import FOPDT, SECOND_ORDER, searched
from autotuner.core.recording import Recording
from autotuner_models.first_order_cycle import fopdt_symmetric
from autotuner_sim import (
    Fopdt,
    Integrating,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    find_limit_cycle,
)
from autotuner_sim.stepped import SteppedPlant
from benchmarks.accuracy.cases.five_switches import HIGH, LOW, cramer_rao, parameters, period_of, random_plant, record

PER_PERIOD = 100
DECIBELS = (40.0, 30.0, 20.0)
PLANTS = (
    Fopdt(1.0, 10.0, 1.0),
    Fopdt(1.65, 20.0, 10.0),
    Fopdt(2.0, 10.0, 10.0),
    Fopdt(1.0, 2.0, 6.0),
    SopdtOverdamped(1.0, 60.0, 15.0, 5.0),
    SopdtOverdamped(1.0, 10.0, 1.0, 2.0),
    SopdtOverdamped(1.5, 7.5, 4.2, 5.0),
    SopdtUnderdamped(1.0, 9.0, 2.4, 1.0),
    SopdtUnderdamped(1.0, 1.0, 0.4, 3.0),
    SopdtUnderdamped(3.5, 9.4, 3.7, 7.0),
    Integrating(0.1, 0.0, 2.0),
    Integrating(0.1, 5.0, 2.0),
)
TELLING = 0.10
"""Relative bound up to which a parameter is judged."""
SHOW = Console(width=150)


def worst_error(model, plant, scale):
    """Return the largest relative error of a parameter; of one that is 0, relative to a time scale."""
    pairs = [(value, getattr(plant, name)) for name, value in model.parameters().items()]
    return max(abs(found - truth) / (abs(truth) or scale) for found, truth in pairs)


def exact(args):
    rng, errors, wrong = np.random.default_rng(1), {}, {}
    for _ in range(args.plants):
        plant = random_plant(rng)
        Pu = period_of(plant)
        found = identify(record(plant, Pu / 150.0))
        errors.setdefault(plant.structure, [])
        if found.structure == plant.structure:
            errors[plant.structure].append(worst_error(found.model, plant, Pu))
        else:
            wrong[plant.structure] = wrong.get(plant.structure, 0) + 1
            SHOW.print(f"wrong structure: {plant} taken for {found.structure}")
    table = Table(title=f"exact: {args.plants} plants, worst parameter of each, percent", title_justify="left")
    for title in ("structure", "plants", "wrong structure", "median", "worst"):
        table.add_column(title, justify="left" if title == "structure" else "right")
    for name, values in sorted(errors.items()):
        cells = (f"{100.0 * of(values):.1e}" for of in (np.median, np.max))
        table.add_row(name, str(len(values) + wrong.get(name, 0)), str(wrong.get(name, 0)), *cells)
    SHOW.print(table)


def as_measured(plant, relay):
    """Return the exact limit cycle in the form in which a measured one comes, with its phase."""
    cycle = find_limit_cycle(plant, relay)
    lowest, highest = cycle.extremes
    lag = -cmath.phase(plant.transfer(2j * math.pi / cycle.period_s)) % (2.0 * math.pi)
    return LimitCycle(
        cycle.period_s, cycle.peak, cycle.fundamental, 1.0, 0.0, 4.0 / math.pi, 0.0, cycle.high_s, cycle.low_s,
        lowest, highest, 0.0, 0.0, 1, lag,
    )  # fmt: skip


def cycles(args):
    rng, worst = np.random.default_rng(2), {}
    for _ in range(args.plants):
        plant = random_plant(rng)
        cycle = as_measured(plant, Relay(-1.0, 1.0))
        if plant.structure == "fopdt":
            model = fopdt_symmetric(plant.K, 1.0, cycle.A, cycle.Pu)
        elif plant.structure == "integrating":
            model = integrating_of_cycle(cycle)
        else:
            model = sopdt_of_cycle(plant.K, cycle)
        error = worst_error(model, plant, cycle.Pu) if model.structure == plant.structure else math.inf
        worst[plant.structure] = max(worst.get(plant.structure, 0.0), error)
    SHOW.print(f"cycles: {args.plants} exact symmetric cycles, worst parameter error by structure:")
    SHOW.print("   " + ", ".join(f"{name} {error:.1e}" for name, error in sorted(worst.items())))


def noise(args):
    for decibels in args.decibels:
        table = Table(title=f"{decibels:g} dB, {args.seeds} seeds", title_justify="left")
        for title in ("plant", "bound %", "error / bound", "interval holds %", "standard error / bound"):
            table.add_column(title)
        ratios, inside = [], []
        for plant in PLANTS:
            misses, bounds, held, errors = trials(plant, decibels, args.seeds)
            truth = np.array(list(parameters(plant).values()))
            bound = np.sqrt(np.mean(bounds**2, axis=0))
            ratio, share = np.sqrt(np.mean(misses**2, axis=0)) / bound, held.mean(axis=0)
            telling = bound < TELLING * np.abs(truth)
            ratios.append(ratio[telling])
            inside.append(held[:, telling])
            table.add_row(
                str(plant),
                " ".join(f"{100.0 * b:.2g}" for b in bound / np.abs(truth)),
                " ".join(f"{r:.2f}" for r in ratio),
                " ".join(f"{100.0 * s:.1f}" for s in share),
                " ".join(f"{e:.2f}" for e in np.median(errors / bounds, axis=0)),
            )
        SHOW.print(table)
        everything = np.concatenate(ratios)
        pooled = np.concatenate([held.ravel() for held in inside])
        plants = [held.mean() for held in inside]
        SHOW.print(
            f"noise {decibels:g} dB: error/bound median {np.median(everything):.2f}, worst {everything.max():.2f}; "
            f"intervals hold {100.0 * pooled.mean():.1f} % pooled, {100.0 * min(plants):.1f} % at the worst plant"
        )


def trials(plant, decibels, seeds):
    """Return misses, bounds, whether the interval held, and standard errors: one row a seed, one column a parameter."""
    dt = period_of(plant) / PER_PERIOD
    sigma = noise_of(plant, dt, decibels)
    truth, rows = parameters(plant), []
    for seed in range(seeds):
        noisy = record(plant, dt, sigma, seed, 3.0 * sigma)
        estimate = identify(noisy, plant.structure).estimates["least_squares"]
        found = estimate.model.parameters()
        rows.append(
            (
                [found[name] - value for name, value in truth.items()],
                cramer_rao(plant, noisy, sigma),
                [
                    estimate.interval95[name][0] <= value <= estimate.interval95[name][1]
                    for name, value in truth.items()
                ],
                [estimate.standard_error[name] for name in truth],
            )
        )
    return tuple(np.array(column) for column in zip(*rows, strict=True))


SHORT = ((Fopdt(1.0, 20.0, 1.0), 0.02), (Fopdt(1.0, 20.0, 1.0), 0.04), (Fopdt(1.0, 40.0, 1.0), 0.02))
"""Plants of which a step is seen over 13 s, and the noise on it."""


def profile(args):
    """Print how often either interval holds the truth of a step that has not settled."""
    table = Table(title=f"steps seen over 13 s, {args.seeds} seeds: the interval holds %", title_justify="left")
    for title in ("plant", "noise", "parameter", "covariance", "profile where it lies", "lies in %"):
        table.add_column(title)
    t = np.arange(0.0, 15.0, 0.05)
    step = (t >= 1.0).astype(float)
    for plant, sigma in SHORT:
        clean = response(found_as(plant), t, step)
        rows = []
        for seed in range(args.seeds):
            noisy = Recording(t, step, clean + sigma * np.random.default_rng(seed).standard_normal(t.size))
            candidate = fit(data_of(noisy), FOPDT)
            plain, best = candidate.uncertainty(profile=False).interval95, candidate.uncertainty()
            rows.append([(held(plain, plant, n), held(best.interval95, plant, n), n in best.profiled) for n in "KTD"])
        for name, shares in zip("KTD", 100.0 * np.mean(rows, axis=0), strict=True):
            table.add_row(str(plant), f"{sigma:g}", name, *(f"{share:.1f}" for share in shares))
    SHOW.print(table)


def found_as(plant):
    return STRUCTURES[plant.structure](**{name: getattr(plant, name) for name in STRUCTURES[plant.structure].__slots__})


def held(intervals, plant, name):
    low, high = intervals[name]
    return low <= getattr(plant, name) <= high


def structures(args):
    """Print how often the structure found is right, another one that fits as well is named, or neither."""
    table = Table(title=f"structure found, of {args.seeds} seeds: right, near-tie named, else", title_justify="left")
    table.add_column("plant")
    for decibels in args.decibels:
        table.add_column(f"{decibels:g} dB")
    for plant in PLANTS:
        cells = [tally(plant, decibels, args.seeds) for decibels in args.decibels]
        table.add_row(str(plant), *(" ".join(str(count) for count in cell) for cell in cells))
    SHOW.print(table)


def tally(plant, decibels, seeds):
    dt, counts = period_of(plant) / PER_PERIOD, [0, 0, 0]
    sigma = noise_of(plant, dt, decibels)
    for seed in range(seeds):
        found = identify(record(plant, dt, sigma, seed, 3.0 * sigma))
        named = any("about as well" in warning and plant.structure in warning for warning in found.warnings)
        counts[0 if found.structure == plant.structure else 1 if named else 2] += 1
    return counts


def noise_of(plant, dt, decibels):
    """Return the noise so far under the mean square of the oscillation."""
    clean = record(plant, dt)
    return float(np.std(clean.pv[len(clean) // 3 :])) * 10.0 ** (-decibels / 20.0)


RECORD = {0.3: (0.6, 0.8, 0.1), 1.0: (0.1, 0.2, 0.04), 3.0: (0.05, 0.15, 0.01)}
"""Median errors to beat, percent: K, T, D by D/T."""


def record_to_beat(args):
    table = Table(title="noise 0.5 % of the PV's span, median errors in percent: K T D", title_justify="left")
    for title in ("D/T", "samples a period", "to beat", "found", "Cramer-Rao median"):
        table.add_column(title)
    for d, known in RECORD.items():
        for per_period in (100, 2000):
            plant = Fopdt(1.0, 10.0, 10.0 * d)
            dt = period_of(plant) / per_period
            sigma = 0.005 * float(np.ptp(record(plant, dt).pv))
            misses, bounds = [], []
            for seed in range(max(args.seeds // 2, 10)):
                # At this many samples, noise alone would pass a dead zone of three sigma now and then.
                noisy = record(plant, dt, sigma, seed, 5.0 * sigma)
                found = identify(noisy, "fopdt").estimates["least_squares"].model.parameters()
                misses.append([abs(found[name] / value - 1.0) for name, value in parameters(plant).items()])
                bounds.append(cramer_rao(plant, noisy, sigma) / list(parameters(plant).values()))
            # The median of a normal distribution's absolute value is 0.6745 of its standard deviation.
            rows = (known, 100.0 * np.median(misses, axis=0), 67.45 * np.median(bounds, axis=0))
            table.add_row(f"{d:g}", str(per_period), *(" ".join(f"{x:.3f}" for x in row) for row in rows))
    SHOW.print(table)
    plant = SopdtOverdamped(1.0, 60.0, 15.0, 5.0)
    found = identify(record(plant, 1.0)).model
    SHOW.print(f"record: 60/15/5 s without noise gives {found}: D off by {100.0 * abs(found.D / 5.0 - 1.0):.1e} %")


def best_of(rounds, function):
    """Return the shortest processor time of some runs, ms."""
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        function()
        times.append(1e3 * (time.process_time() - begin))
    return min(times)


def speed(_args):
    plant = SopdtOverdamped(1.0, 10.0, 2.0, 4.0)
    Pu = period_of(plant)
    noisy = record(plant, Pu / 1000.0, 0.005, 1, 0.015).window(0.0, 1999.5 * Pu / 1000.0)
    system = scipy.signal.lti([1.0], np.polymul([10.0, 1.0], [2.0, 1.0]))
    once = best_of(7, lambda: scipy.signal.lsim(system, noisy.output, noisy.t, interp=False))
    data = data_of(noisy)
    rows = {f"least squares, {s.name}": (lambda s=s: fit(data, s)) for s in (FOPDT, SECOND_ORDER)}
    rows["least squares, every structure there is, with intervals"] = lambda: [
        candidate.uncertainty() for candidate in (fit(data, s) for s in searched("auto")) if candidate is not None
    ]
    rows["identify, structure found by itself, all estimators"] = lambda: identify(noisy)
    table = Table(title=f"{len(noisy)} samples; one lsim {once:.2f} ms", title_justify="left")
    for title in ("what", "ms", "lsim runs"):
        table.add_column(title, justify="left" if title == "what" else "right")
    for name, function in rows.items():
        took = best_of(7, function)
        table.add_row(name, f"{took:.1f}", f"{took / once:.0f}")
    SHOW.print(table)


def degenerate_records():
    """Yield names and recordings that show little or nothing."""
    rng, n = np.random.default_rng(5), 400
    t, step = np.arange(float(n)), (np.arange(n) >= 100).astype(float)
    yield "constant output", Recording(t, np.ones(n), rng.standard_normal(n))
    yield "one switch, far from settled", record_of_step(Fopdt(2.0, 500.0, 5.0), 150)
    yield "all noise", Recording(t, np.where(np.arange(n) // 50 % 2, 1.0, -1.0), rng.standard_normal(n))
    yield "unstable growth", Recording(t, step, np.exp(0.03 * t) - 1.0)
    noisy = record(Fopdt(2.0, 10.0, 3.0), 0.1, 0.01, 1, 0.03)
    yield "saturated PV", Recording(noisy.t, noisy.output, np.minimum(noisy.pv, 0.4))
    half = len(noisy) // 2
    yield "frozen PV", Recording(noisy.t, noisy.output, np.where(noisy.t < noisy.t[half], noisy.pv, noisy.pv[half]))
    wild = np.where(np.arange(len(noisy)) % 50 == 7, 32767.0, noisy.pv)
    yield "32767 now and then", Recording(noisy.t, noisy.output, wild)
    yield "output and PV swapped", Recording(noisy.t, noisy.pv, noisy.output)
    yield "two samples", Recording(t[:2], step[99:101], t[:2])
    yield "constant PV", Recording(t, step, np.full(n, 7.0))
    many = np.arange(1e7)
    output = np.where(many // 1_000_000 % 2, HIGH, LOW)
    yield (
        "ten million samples",
        Recording(many * 0.1, output, np.cumsum(output) * 1e-6 + 0.01 * rng.standard_normal(many.size)),
    )
    yield "ten million moves", Recording(many * 0.1, rng.standard_normal(many.size), rng.standard_normal(many.size))


def record_of_step(plant, samples):
    device, rows = SteppedPlant(plant), []
    for k in range(samples):
        device.advance(float(k))
        rows.append((float(k), float(k >= 50), device.pv))
        device.output = rows[-1][1]
    return Recording(*np.array(rows).T)


def degenerate(_args):
    for name, recording in degenerate_records():
        begin = time.perf_counter()
        found = identify(recording)
        took = time.perf_counter() - begin
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        told = f"{found.verdict.outcome.value}, {found.verdict.message}"
        SHOW.print(f"{name} ({took:.1f} s; {peak:.0f} MB at most so far): {told}")
        for warning in found.warnings:
            SHOW.print(f"    warning: {warning}")


SECTIONS = {
    "exact": exact,
    "cycles": cycles,
    "noise": noise,
    "profile": profile,
    "structures": structures,
    "record": record_to_beat,
    "speed": speed,
    "degenerate": degenerate,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], help="what to run; all by default")
    parser.add_argument("--plants", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--decibels", type=float, nargs="+", default=DECIBELS, help="of `noise`")
    args = parser.parse_args()
    for name in args.sections or SECTIONS:
        SECTIONS[name](args)


if __name__ == "__main__":
    main()
