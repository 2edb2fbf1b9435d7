"""Equal lags and third order: structure, static gain and gains from one relay record at 30 dB.

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.estimates.higher_order [--plants 20] [--seed 100] [--decibels 30]
                                                                           [--failures]

Relay from rest, 100 samples a period, 8 half periods, levels -1 and 1.5; nothing of the process is given. Seeds below
100 were developed on.

Third order is one structure, whether two of its poles are a pair or not: nearly equal lags may come out as either.
Evidence can tell the structures apart where every rival, fitted to the same record without noise, misses by so much
that its criterion is expected to be higher by `EVIDENT`:

    N ln(1 + r^2/sigma^2) + (p_rival - p_true) price >= EVIDENT,   r the rival's rms there, p the parameters

The static gain is held against what a record can tell at all: the Cramer-Rao bound of its standard error, with the
true structure known, lags, dead time and offset not (Kay, Fundamentals of Statistical Signal Processing, 1993, ch. 3):

    bound^2 = sigma^2 [(J' J)^-1]_KK,   J the derivative of the simulated PV by K, denominator, D and offset

Gains are those of the goal "balanced". They are judged on the true process, with half a sample for the hold, by the
integrated error after a load step over that of the best PID controller with Ms and Mt at most 1.4.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
import warnings
from dataclasses import replace

import numpy as np

from autotuner.application.analysis.procedure import gains_for
from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.least_squares import fit
from autotuner.core.identification import identify
from autotuner.core.model.structures import FOPDT, INVERSE_RESPONSE, N_LAGS, SECOND_ORDER, THIRD_ORDER
from autotuner.core.recording import Recording
from autotuner_sim import RationalPlant, SteppedPlant
from benchmarks.accuracy.tuning.gains import best_error
from benchmarks.baselines.amigo_batch import Process, lag, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities

REST, PER_PERIOD, LOW, HIGH, HALF_PERIODS = 50, 100, -1.0, 1.5, 8
EVIDENT, PRICE = 12.0, 12.0
"""Difference of the criterion that counts as evidence, twice that of a near tie; price of a parameter, as in a fit."""
COLUMNS = (
    *("process", "plants", "evident", "right of those", "right of all", "K within 3 %", "median K error"),
    *("median bound of K", "K within 1.96 bounds"),
    *("error over the optimum: median", "worst", "within 1.1", "time"),
)
DIFFERENCE = 1e-4
"""Relative step of the central differences: their error is its square."""
KINDS = ("n_lags", "third_order", "third_order_underdamped")


def drawn(kind, count, seed):
    """Return true processes: factors of the denominator, dead time, and the number of lags where they are equal."""
    rng = np.random.default_rng((seed, KINDS.index(kind)))
    found = []
    for _ in range(count):
        gain, scale = 10.0 ** rng.uniform(-0.5, 0.5), 10.0 ** rng.uniform(-1.0, 2.0)
        if kind == "n_lags":
            n = int(rng.integers(3, 7))
            factors = (lag(scale),) * n
        elif kind == "third_order":
            T2 = scale * rng.uniform(0.2, 0.9)
            factors = (lag(scale), lag(T2), lag(T2 * rng.uniform(0.2, 0.9)))
        else:
            z = rng.uniform(0.2, 0.8)
            factors = ((1.0, 2.0 * z * scale, scale**2), lag(scale * rng.uniform(0.3, 1.5)))
        lags = sum(factor[1] for factor in factors)
        found.append(Process(kind, kind, gain, (), factors, lags * rng.uniform(0.02, 0.5)))
    return found


def denominator_of(process):
    """Return the denominator multiplied out, as ascending coefficients."""
    return functools.reduce(np.polynomial.polynomial.polymul, process.denominator)


def device_of(process):
    """Return the process at rest."""
    return SteppedPlant(RationalPlant((process.gain,), tuple(denominator_of(process)), process.D))


def recorded(process, decibels, seed):
    """Return the record with noise, the same relay's without, and sigma."""
    Ku, Pu = ultimate(process)
    sigma = 2.0 * (HIGH - LOW) / (math.pi * Ku) / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    device = device_of(process)
    rng, rows, clean, is_high, switched, k = np.random.default_rng(seed), [], [], True, -1, 0
    while switched < HALF_PERIODS:
        t = k * Pu / PER_PERIOD
        device.advance(t)
        pv = device.pv + sigma * rng.standard_normal()
        was = is_high
        if k > REST and abs(pv) > 3.0 * sigma:
            is_high = pv < 0.0
        switched += is_high != was
        device.output = 0.0 if k < REST else HIGH if is_high else LOW
        rows.append((t, device.output, pv))
        clean.append(device.pv)
        k += 1
    times, output, pv_seen = np.array(rows).T
    record = Recording(times, output, pv_seen, settings={"noise_sigma": sigma})
    return record, replace(record, pv=np.array(clean)), sigma


def simulated(process, record):
    """Return the PV without noise at the record's output."""
    device, pv = device_of(process), []
    for t, output in zip(record.t, record.output, strict=True):
        device.advance(t)
        pv.append(device.pv)
        device.output = output
    return np.array(pv)


def gain_bound(process, record, sigma):
    """Return the least standard error that an unbiased estimate of the static gain can have, relative."""
    truth = np.array([process.gain, process.D, *coefficients(process)])
    slopes = []
    for k, value in enumerate(truth):
        ends = []
        for step in (DIFFERENCE, -DIFFERENCE):
            theta = truth.copy()
            theta[k] = value * (1.0 + step)
            ends.append(simulated(with_coefficients(process, theta), record))
        slopes.append((ends[0] - ends[1]) / (2.0 * DIFFERENCE))
    J = np.column_stack((*slopes, np.ones(record.t.size)))
    return sigma * math.sqrt(np.linalg.inv(J.T @ J)[0, 0])


def coefficients(process):
    """Return what the denominator has free: one lag, or the three coefficients of a polynomial."""
    if process.name == "n_lags":
        return [process.denominator[0][1]]
    return denominator_of(process)[1:]


def with_coefficients(process, theta):
    """Return the process with other values of gain, dead time and denominator."""
    gain, D, *free = theta
    n = len(process.denominator)
    denominator = (lag(free[0]),) * n if process.name == "n_lags" else ((1.0, *free),)
    return replace(process, gain=gain, D=D, denominator=denominator)


def true_structure(process):
    """Return the structure that a process is of."""
    return N_LAGS[len(process.denominator) - 3] if process.name == "n_lags" else THIRD_ORDER


def is_evident(process, clean, sigma):
    """Return whether the record can tell the true structure from every other one."""
    data, truth = data_of(clean), true_structure(process)
    own = truth.size + truth.chosen
    beside = {FOPDT, SECOND_ORDER, INVERSE_RESPONSE, THIRD_ORDER, *N_LAGS} - {truth}
    for rival in beside:
        candidate = fit(data, rival)
        if candidate is None:
            continue
        misses = data.t.size * math.log1p((candidate.rmse / sigma) ** 2)
        if misses + (rival.size + rival.chosen - own) * PRICE < EVIDENT:
            return False
    return True


def judged(process, found, dt):
    """Return integrated error over the optimum, and Ms; infinite for an unstable loop."""
    Pu = ultimate(process)[1]
    own = (found.Kp, found.Ti, found.Td, found.Tf)
    sampled = replace(process, D=process.D + dt / 2.0)
    Ms, _, stable = sensitivities(sampled, own, Pu)
    if not stable:
        return math.inf, math.inf
    return iae(sampled, own, Pu) / best_error(sampled, [found.Kp, found.Ti, found.Td]), Ms


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--decibels", type=float, default=30.0)
    parser.add_argument("--failures", action="store_true")
    parser.add_argument("--no-gains", action="store_true", help="structure and static gain only")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for kind in KINDS:
        rows = []
        for number, process in enumerate(drawn(kind, args.plants, args.seed)):
            record, clean, sigma = recorded(process, args.decibels, (args.seed, number))
            began = time.process_time()
            found = identify(record)
            spent = time.process_time() - began
            right = str(found.structure).startswith("third_order" if kind != "n_lags" else kind)
            if right and kind == "n_lags":
                right = found.model.n == len(process.denominator)
            gain = math.inf if found.model is None else abs(found.model.K / process.gain - 1.0)
            ratio = math.nan
            if found.model is not None and not args.no_gains:
                gains = gains_for(found, sample_time_s=record.sample_interval_s)
                ratio = judged(process, gains.gains, record.sample_interval_s)[0]
            bound = gain_bound(process, record, sigma)
            rows.append((is_evident(process, clean, sigma), right, gain, ratio, spent, bound))
            if args.failures and not right:
                told = found.verdict.message if found.model else found.verdict.code
                print(f"  {kind} {process.denominator} D {process.D:.3g}: {rows[-1][0]} {told}", flush=True)
        evident, rights, errors, ratios, times, bounds = np.array(rows, float).T
        can = evident > 0.0
        print(
            f"| {kind} | {len(rows)} | {int(can.sum())} | {rights[can].mean():.0%} | {rights.mean():.0%} | "
            f"{(errors <= 0.03).mean():.0%} | {100.0 * np.median(errors):.2g} % | "
            f"{100.0 * np.median(bounds):.2g} % | {(errors <= 1.96 * bounds).mean():.0%} | {np.median(ratios):.3f} | "
            f"{ratios.max():.3f} | {(ratios <= 1.1).mean():.0%} | {np.median(times):.2f} s |",
            flush=True,
        )


if __name__ == "__main__":
    main()
