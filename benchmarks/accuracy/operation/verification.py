"""Verification steps with right and wrong models: how many pass, how many go back, and how far the PV got.

    python benchmarks/accuracy/operation/verification.py [--plants N]

Plants are drawn at random (seeded). Gains are designed for a model that is right, has half or twice the gain, or half
the dead time, or is right but hides a valve that sticks over 80 % of the output's final move. The loop makes a step of
set point and load at once with noise of 1 % of the step, sampled five times in a dead time at least; the judge sees PV
and output and passes, or goes back.
"""

import argparse

import numpy as np

from autotuner.core.design import (
    Decision,
    PidSettings,
    Scenario,
    Verification,
    design,
    margins,
    predict,
    predicted_band,
)
from autotuner.core.model.process import Fopdt, SopdtOverdamped

STEP, NOISE, STICKING = 1.0, 0.01, 0.8
WRONG = {
    "right": {},
    "gain halved": {"K": 0.5},
    "gain doubled": {"K": 2.0},
    "dead time halved": {"D": 0.5},
    "sticking": {},
}


def plants(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        K, T, D = rng.uniform(0.5, 3.0), rng.uniform(3.0, 20.0), rng.uniform(0.5, 8.0)
        yield SopdtOverdamped(K, T, T * rng.uniform(0.05, 0.9), D) if rng.random() < 0.5 else Fopdt(K, T, D)


class Sticking:
    def __init__(self, band):
        self.band, self.position = band, 0.0

    def __call__(self, command):
        if abs(command - self.position) > self.band:
            self.position = command
        return self.position


def verify(truth, factors, actuator, seed):
    """Return the decision, Ms of the true loop, and the largest PV before the decision."""
    values = {name: value * factors.get(name, 1.0) for name, value in truth.parameters().items()}
    settings = PidSettings(design(type(truth)(**values)).gains)
    span = 8.0 * (truth.D + sum(truth.parameters().get(name, 0.0) for name in ("T", "T1", "T2")))
    sample_time_s = min(span / 400.0, truth.D / 5.0)
    scenario = Scenario(span, sample_time_s, set_point_step=STEP, load_step=STEP / truth.K)
    judge = Verification(predicted_band(type(truth)(**values), settings, scenario, noise_sigma=NOISE))
    noise = NOISE * np.random.default_rng(seed).standard_normal(int(span / sample_time_s) + 2)
    seen = predict(truth, settings, scenario, actuator=actuator, noise=noise)
    largest = 0.0
    for t, pv, output in zip(seen.t, seen.pv, seen.output, strict=True):
        largest = max(largest, abs(float(pv)))
        decision = judge.step(float(t), float(pv), float(output))
        if decision is not Decision.GO_ON:
            break
    return decision, margins(truth, settings.gains).Ms, largest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=50)
    args = parser.parse_args()
    head = f"{'model':18s} {'plants':>7s} {'pass':>6s} {'back':>6s} {'largest PV, steps':>18s}"
    print(f"{head}  true Ms of those that passed")
    for name, factors in WRONG.items():
        results = [
            verify(truth, factors, Sticking(STICKING * STEP / truth.K) if name == "sticking" else None, seed)
            for seed, truth in enumerate(plants(args.plants, 11))
        ]
        passed = [Ms for decision, Ms, _ in results if decision is Decision.PASS]
        largest = max(size for _, _, size in results)
        shown = "" if not passed else f"{min(passed):.2f} to {max(passed):.2f}"
        print(f"{name:18s} {len(results):7d} {len(passed):6d} {len(results) - len(passed):6d} {largest:18.2f}  {shown}")


if __name__ == "__main__":
    main()
