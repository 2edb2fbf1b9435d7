"""What a drift does beyond the part of a record that it was fitted to: a line carried on, its last value, or the rule.

    python benchmarks/accuracy/estimates/carried_on.py [--seeds 14]

A process of two lags (or of three, which no structure has) is moved to and fro at random, from rest or since long
before. One of five things moves its PV too: a straight line, a random walk, surroundings that warm up, a disturbance
that comes and goes, a slow sine. The process is identified from the first half, and simulated over the second; of the
records in which it finds a line the geometric mean of the root mean square errors there is printed, with the line
carried on, with its last value, and as `drifting.goes_straight_on` decides.
"""

import argparse
import math
import warnings
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from autotuner.core.identification import identify, simulate_fit
from autotuner.core.recording import Recording

SAMPLES = 1200
NOISE = 0.02
RULE = "autotuner.core.estimation.simulation.goes_straight_on"
WAYS = {"line": lambda *_: True, "last value": lambda *_: False}


def lag(values, T):
    """Return values held from second to second through a lag."""
    decay = math.exp(-1.0 / T)
    return lfilter([0.0, 1.0 - decay], [1.0, -decay], values)


def wandering(kind, size, rng):
    """Return what moves the PV besides the output; it moves by about `size` in half a record."""
    t, half = np.arange(SAMPLES), SAMPLES / 2.0
    white = rng.standard_normal(4 * SAMPLES)
    moved = {
        "straight line": lambda: size * t / half,
        "random walk": lambda: size * np.cumsum(white[:SAMPLES]) / math.sqrt(half),
        "warming up": lambda: -2.0 * size * np.expm1(-t / (half * rng.uniform(0.3, 1.5))),
        "coming and going": lambda: lag(white, rng.uniform(50.0, 300.0))[-SAMPLES:],
        "slow sine": lambda: size * np.sin(2.0 * math.pi * (t / rng.uniform(1200.0, 4000.0) + rng.uniform())),
    }[kind]()
    return moved * size / (2.0 * moved.std()) if kind == "coming and going" else moved


KINDS = ("straight line", "random walk", "warming up", "coming and going", "slow sine")


def record(kind, *, at_rest, three_lags, seed):
    """Return one record."""
    rng = np.random.default_rng([seed, KINDS.index(kind), at_rest, three_lags])
    T1 = rng.uniform(15.0, 60.0)
    T2 = T1 * rng.uniform(0.1, 0.6)
    hold = max(3, int(T1 * rng.uniform(0.2, 0.6)))
    before = 0 if at_rest else SAMPLES // 2
    output = np.repeat(rng.choice([-1.0, 1.0], SAMPLES), hold)[: SAMPLES + before]
    if at_rest:
        output[:80] = 0.0
    pv = lag(lag(rng.uniform(0.5, 2.0) * output, T1), T2)
    pv = lag(pv, 0.8 * T2) if three_lags else pv
    late = int(0.2 * T1)
    pv = np.concatenate((np.zeros(late), pv))[before : before + SAMPLES]
    size = rng.uniform(0.1, 0.8) * rng.choice([-1.0, 1.0])
    pv = pv + wandering(kind, size, rng) + NOISE * rng.standard_normal(SAMPLES)
    return Recording(np.arange(float(SAMPLES)), output[before:], pv)


def errors(recording):
    """Return the error on the second half by way, or None where no line was found."""
    until_s = SAMPLES / 2.0
    found = identify(recording.window(0.0, until_s))
    told = found.estimates["least_squares"]
    model = found.model or told.model
    if model is None or "drift" not in told.evidence["background"] or model.rational().a[0] <= 0.0:
        return None

    def error():
        left = recording.pv - simulate_fit(model, recording, until_s)
        return math.sqrt(float(np.mean(left[recording.t > until_s] ** 2)))

    result = {}
    for way, straight in WAYS.items():
        with patch(RULE, straight):
            result[way] = error()
    return result | {"by the rule": error()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=14)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    table = Table("moves the PV too", "process", "begins", "with a line", *WAYS, "by the rule")
    logs = []
    for kind in KINDS:
        for three_lags in (False, True):
            for at_rest in (False, True):
                records = [record(kind, at_rest=at_rest, three_lags=three_lags, seed=s) for s in range(args.seeds)]
                found = [e for e in map(errors, records) if e is not None]
                if not found:
                    continue
                values = np.log([list(e.values()) for e in found])
                logs.append(values)
                means = [f"{value:.3g}" for value in np.exp(values.mean(axis=0))]
                told = (kind, "three lags" if three_lags else "two lags", "at rest" if at_rest else "in motion")
                table.add_row(*told, f"{len(found)} of {args.seeds}", *means)
    everything = np.exp(np.vstack(logs).mean(axis=0))
    table.add_row("all", "", "", str(sum(map(len, logs))), *(f"{value:.3g}" for value in everything))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
