"""Slow loops sampled quickly: does the noise switch the relay while it waits for the process?

    python benchmarks/accuracy/experiment/quick_sampling.py [--seeds 200] [--jobs 2]

First-order processes with D/T 0.15, 1 and 2, sampled 10, 100 and 1,000 times in a dead time, with white noise of 1 and
5 % of the amplitude of their oscillation. Told are the experiments that ended with a result, and those in which the
relay switched before the process can have answered.

Required, exit code 1 otherwise: all end with a result.
"""

import argparse
import itertools
import sys
from collections import Counter

import joblib
import numpy as np

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.recording import Sample
from autotuner_sim import Fopdt, Noise, SteppedPlant, find_limit_cycle, symmetric_relay

OUTPUT0, PV0, AMPLITUDE, K, D = 40.0, 80.0, 10.0, 2.0, 30.0
RATIOS, RATES, SHARES = (0.15, 1.0, 2.0), (10, 100, 1000), (0.01, 0.05)
LONGEST = 100
"""Most dead times that an experiment may take."""


def conduct(ratio, rate, share, seed):
    """Return how an experiment ended, and whether the relay switched within a dead time after its start."""
    plant = Fopdt(K, D / ratio, D)
    sigma = share * AMPLITUDE * find_limit_cycle(plant, symmetric_relay()).peak
    loop = SteppedPlant(plant, output0=OUTPUT0, pv0=PV0, sensors=[Noise(sigma, seed=seed)])
    settings = ExperimentSettings(sample_time_s=D / rate, amplitude=AMPLITUDE, quiet_s=50 * D / rate, check=False)
    run, output, moved = Experiment(settings, OUTPUT0), OUTPUT0, []
    for k in range(LONGEST * rate):
        t = k * settings.sample_time_s
        loop.advance(t)
        command = run.step(Sample(t, loop.measure(), output))
        if command.phase is Phase.RESTORE:
            break
        if command.output != output:
            moved.append(t)
        loop.output = output = command.output
    code = run.verdict.code if run.verdict else "done" if run.phase is Phase.RESTORE else "not ended"
    return code, len(moved) > 1 and moved[1] - moved[0] < D


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    failed = 0
    print("D/T    samples in D   noise   result     switched by noise   other ends")
    for ratio, rate, share in itertools.product(RATIOS, RATES, SHARES):
        ends = joblib.Parallel(args.jobs)(
            joblib.delayed(conduct)(ratio, rate, share, seed) for seed in range(args.seeds)
        )
        codes = Counter(code for code, _ in ends)
        done = codes.pop("done", 0)
        failed += args.seeds - done
        early = int(np.sum([early for _, early in ends]))
        ended, others = f"{done}/{args.seeds}", dict(codes) or ""
        print(f"{ratio:<6g} {rate:12d} {share:7.0%} {ended:>10} {early:16d}          {others}")
    print(f"{failed} without a result")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
