"""What a sample of the relay phase costs: the streaming band-pass and the detector beside SciPy called once a sample.

    python benchmarks/latency/filters.py [--rounds N]

sosfilt   `scipy.signal.sosfilt` on one sample with two sections and their state: what a stream of samples would call
sample    `Detector.step` between two switches, with its share of the filter (two sections), which is run at the switch
filter    that share alone: `BandPass.run`, a sample
switch    what the detector does at a switch beside the filter: period, peaks by their fits, fundamental
whole     sample with its share of the switch, 50 samples apart
limit     a sample only taken from two lists and kept in two others

A sine of 100 samples a period with a relay; all in turns, in processor time, and the least of all rounds counts.
"""

import argparse
import math
import time

import numpy as np
import scipy.signal

from autotuner.core.signals.bandpass import BandPass
from autotuner.core.signals.detector import Detector

PERIOD, PERIODS = 100, 40
PV = [math.sin(2.0 * math.pi * k / PERIOD) for k in range(PERIOD * PERIODS)]
TIMES = [float(k) for k in range(len(PV))]
HIGH = [k // (PERIOD // 2) % 2 == 0 for k in range(len(PV))]
CALLS = 200
HALVES_TRIED = (50, 500, 6000)
HALVES = [list(zip(TIMES, PV, HIGH, strict=True))[k : k + PERIOD // 2] for k in range(0, len(PV), PERIOD // 2)]


def by_scipy():
    sections, state = scipy.signal.butter(2, (0.01, 0.04), "bandpass", output="sos"), np.zeros((2, 2))
    begun = time.process_time()
    for pv in PV[:CALLS]:
        _, state = scipy.signal.sosfilt(sections, [pv], zi=state)
    return (time.process_time() - begun) / CALLS


def by_the_detector():
    """Return the time of the steps of all samples, and of those with a switch, s."""
    detector = Detector()
    whole = at_switches = 0.0
    for rows in HALVES:
        begun = time.process_time()
        t, pv, is_high = rows[0]
        detector.step(t, pv, is_high)
        switched = time.process_time()
        for t, pv, is_high in rows[1:]:
            detector.step(t, pv, is_high)
        whole += time.process_time() - switched
        if len(detector.cycles) > 1:
            at_switches += switched - begun
    return whole / (len(PV) * (1.0 - 2.0 / PERIOD)), at_switches / (len(detector.cycles) - 1)


def at_a_switch(half):
    """Return the least time of a switch with so many samples a half period, s."""
    detector, least = Detector(), math.inf
    for k in range(10 * half):
        begun = time.process_time()
        cycle = detector.step(float(k), math.sin(math.pi * k / half), k // half % 2 == 0)
        least = least if cycle is None else min(least, time.process_time() - begun)
    return least


def by_the_filter():
    band, steps = BandPass(float(PERIOD)), [1.0] * (PERIOD // 2)
    begun = time.process_time()
    for first in range(0, len(PV), PERIOD // 2):
        band.run(PV[first : first + PERIOD // 2], steps)
    return (time.process_time() - begun) / len(PV)


def kept():
    times, values = [], []
    begun = time.process_time()
    for t, pv in zip(TIMES, PV, strict=True):
        times.append(t)
        values.append(pv)
    return (time.process_time() - begun) / len(PV)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    best = dict.fromkeys(("sosfilt", "sample", "filter", "switch", "whole", "limit"), math.inf)
    for _ in range(args.rounds):
        steps, switch = by_the_detector()
        share = by_the_filter()
        found = {
            "sosfilt": by_scipy(),
            "sample": steps + share,
            "filter": share,
            "switch": switch - share * PERIOD / 2.0,
            "whole": steps + share + (switch - share * PERIOD / 2.0) / (PERIOD / 2.0),
            "limit": kept(),
        }
        best = {name: min(best[name], found[name]) for name in best}
    print(f"{'':10} {'us':>8} {'times faster than sosfilt':>26}")
    for name, seconds in best.items():
        print(f"{name:10} {1e6 * seconds:8.3f} {best['sosfilt'] / seconds:26.1f}")
    for half in HALVES_TRIED:
        print(f"all of a switch with {half} samples a half period: {1e3 * at_a_switch(half):.2f} ms")


if __name__ == "__main__":
    main()
