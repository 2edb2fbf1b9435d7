"""A take-over that moves the output by a little: do the intervals of the model still hold?

    python benchmarks/accuracy/take_over.py [--seeds 100] [--first 1] [--offset 0 0.2 ...] [--pid Kp,Ti,Td ...]

Until take-over the output differs by a constant offset from the one held from then on, which is what the record says
throughout; the PV is at rest at the former. With `--pid` the device's own controller drives the output until then, on
the noisy PV with a scan of 0.05 s, and the mean of its last 25 outputs is held. A whole experiment with default
settings follows, on a plant of `autotuner_sim` with K = 2, T = 5 s, D = 0.7 s and white noise of 0.2, read to 0.1 every
0.1 s, with a relay amplitude of 10.

    before     offset of the output before take-over, output units, or the gains of the device's own controller
    refused    experiments without a result
    inside     share of results whose 95 % interval holds the true K, T, D
    error      median error of K, and that of 90 %
    half       median half width of the interval of K, as a share of K
"""

import argparse
import math
from typing import Any

import numpy as np

from autotuner.control.driving.controller import OBSERVED
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.identification import identify, running_model
from autotuner.core.recording import Recording, Sample
from autotuner_sim import Fopdt, Noise, SteppedPlant

TRUTH = {"K": 2.0, "T": 5.0, "D": 0.7}
OUTPUT0, PV0, AMPLITUDE, SIGMA, SAMPLE_S = 40.0, 80.0, 10.0, 0.2, 0.1
RESOLUTION = 0.1
REST_S = 60.0
"""Time under the device's own controller: 12 lags."""
SCAN_S = 0.05
LONGEST = 20_000


def held_at_offset(offset):
    """Return what brings a loop to rest at an output that differs by an offset from the one held from then on."""

    def rest(loop):
        loop.output = OUTPUT0 + offset
        loop.advance(REST_S)
        return OUTPUT0

    return rest


def driven_by_pid(Kp, Ti, Td):
    """Return what has a loop driven by its own controller; the mean of its last outputs is held from then on."""

    def rest(loop):
        integral, last, outputs = OUTPUT0, PV0, []
        for k in range(1, round(REST_S / SCAN_S) + 1):
            loop.advance(k * SCAN_S)
            pv = measured(loop)
            integral += Kp / Ti * (PV0 - pv) * SCAN_S
            loop.output = integral + Kp * (PV0 - pv) - Kp * Td * (pv - last) / SCAN_S
            last = pv
            outputs.append(loop.output)
        return float(np.mean(outputs[-OBSERVED * round(SAMPLE_S / SCAN_S) :: round(SAMPLE_S / SCAN_S)]))

    return rest


def measured(loop):
    return round(loop.measure() / RESOLUTION) * RESOLUTION


def conducted(rest, seed):
    """Return the recording of an experiment after what went before it; None where it was refused."""
    loop = SteppedPlant(Fopdt(*TRUTH.values()), output0=OUTPUT0, pv0=PV0, sensors=[Noise(SIGMA, seed=seed)])
    loop.advance(0.0)
    output = rest(loop)
    settings = ExperimentSettings(sample_time_s=SAMPLE_S, amplitude=AMPLITUDE)
    experiment, samples = Experiment(settings, output), []
    for k in range(LONGEST):
        t = k * SAMPLE_S
        loop.advance(REST_S + t)
        loop.output = output
        pv = measured(loop)
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            break
        loop.output = output = command.output
        samples.append(Sample(t, pv, output))
        if command.estimate is not None and command.estimate.half_period >= 2:
            seen: Any = experiment.settings_so_far()
            model = running_model(Recording.from_samples(samples, seen), seen["noise_sigma"])
            experiment.inform(math.inf if model is None else model.relative_error)
    if experiment.verdict is not None:
        return None
    return Recording.from_samples(samples, experiment.settings_so_far())


def judged(recording):
    """Return which true values are inside their intervals, the error of K and the half width of its interval."""
    found = identify(recording, "fopdt")
    estimate = found.estimates[found.recommended or "least_squares"]
    inside = [low <= TRUTH[name] <= high for name, (low, high) in estimate.interval95.items() if name in TRUTH]
    low, high = estimate.interval95["K"]
    return inside, abs(estimate.model.K / TRUTH["K"] - 1.0), (high - low) / 2.0 / TRUTH["K"]


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--offset", type=float, nargs="*", default=[0.0, 0.1, 0.3, 1.0])
    parser.add_argument("--pid", nargs="*", default=["0.5,5,0", "2,5,0.2"], help="gains of the device's own controller")
    args = parser.parse_args()
    scenes = {f"{offset:g}": held_at_offset(offset) for offset in args.offset}
    scenes |= {f"PID {gains}": driven_by_pid(*map(float, gains.split(","))) for gains in args.pid}
    print("| before | refused | inside K, T, D | error K, 90 % | half |\n|---|---|---|---|---|", flush=True)
    for name, rest in scenes.items():
        records = [conducted(rest, seed) for seed in range(args.first, args.first + args.seeds)]
        rows = [judged(recording) for recording in records if recording is not None]
        inside = np.mean([row[0] for row in rows], axis=0)
        errors, half = [row[1] for row in rows], float(np.median([row[2] for row in rows]))
        shares = ", ".join(f"{share:.3f}" for share in inside)
        error = f"{np.median(errors):.4f}, {np.quantile(errors, 0.9):.4f}"
        print(f"| {name} | {args.seeds - len(rows)} | {shares} | {error} | {half:.4f} |", flush=True)


if __name__ == "__main__":
    main()
