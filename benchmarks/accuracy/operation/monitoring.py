"""A loop in its normal running: how often is the right thing said of it, and how often something wrong?

    python benchmarks/accuracy/operation/monitoring.py [--seeds N] [--first K]

Loops of the simulator with random processes (D/T 0.05 to 1.5, gain 0.3 to 6), under a PI controller tuned for the
process that is expected, sampled twenty times an ultimate period; noise a hundredth of a set-point step. One change a
case, of random size. Told is what share of each kind got which code.
"""

import argparse
import math
from collections import Counter

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.design import PidGains, ultimate_point
from autotuner.core.model import process
from autotuner.core.monitoring import Expected, findings
from autotuner.core.monitoring.changes import CODES
from autotuner.core.recording import Recording
from autotuner_sim import (
    Backlash,
    Fopdt,
    HeStiction,
    LoadStep,
    Noise,
    PeriodicLoad,
    SteppedPlant,
    Stiction,
)

PERIODS, A_PERIOD = 120, 20
STEPS = (0.0, 1.0, -0.5, 0.7, 0.2)
STILL = (0.0,)
ONCE = (0.0, 1.0, 1.0, 1.0, 1.0, 1.0)


def pi_of(model):
    """Return the PI gains of the rule SIMC with tau_c = D."""
    return PidGains(model.T / (2.0 * model.K * model.D), min(model.T, 8.0 * model.D), 0.0)


def run(plant, gains, period_s, moves, seed, **hidden):
    """Return a window under a PI controller; set points of the size of the process's gain times ten."""
    dt, size = period_s / A_PERIOD, 10.0 * plant.K
    step = 5.0 * hidden.pop("expected_K", plant.K)
    loop = SteppedPlant(plant, output0=50.0, pv0=100.0, sensors=[Noise(0.01 * size, seed)], **hidden)
    rows, total, count = [], 0.0, PERIODS * A_PERIOD
    for k in range(count):
        loop.advance(k * dt)
        pv, set_point = loop.measure(), 100.0 + step * moves[k * len(moves) // count]
        total += (set_point - pv) * dt
        loop.output = min(max(50.0 + gains.Kp * (set_point - pv + total / gains.Ti), 0.0), 100.0)
        rows.append((k * dt, loop.output, pv, set_point))
    return Recording(*(np.array(column) for column in zip(*rows, strict=True)))


def kinds(rng, model, period_s, end_s):
    """Yield name, what is right, the true process, gains, moves of the set point, hidden things."""
    K, T, D, gains = model.K, model.T, model.D, pi_of(model)
    up, down = rng.uniform(1.4, 2.0), rng.uniform(0.45, 0.7)
    eager = PidGains(gains.Kp, 0.5 * gains.Ti, 0.0)
    at_s, load = rng.uniform(0.2, 0.6) * end_s, rng.choice((-1.0, 1.0)) * rng.uniform(5.0, 15.0)
    same, band = Fopdt(K, T, D), rng.uniform(2.0, 6.0)
    wave = [PeriodicLoad(rng.uniform(3.0, 8.0), rng.uniform(3.0, 12.0) * period_s)]
    ultimate = PidGains(0.93 * ultimate_point(model).Ku, 8.0 * period_s, 0.0)
    yield "as it was, set point moves", {"as_expected"}, same, gains, STEPS, {}
    yield "as it was, at rest", {"at_rest", "as_expected"}, same, gains, STILL, {}
    for name, factor in (("up", up), ("down", down)):
        yield f"gain {name}", {"retune_advised"}, Fopdt(K * factor, T, D), gains, STEPS, {}
        yield f"time constant {name}", {"retune_advised"}, Fopdt(K, T * factor, D), gains, STEPS, {}
    yield "dead time up", {"retune_advised"}, Fopdt(K, T, D * up), gains, STEPS, {}
    yield "hunts", {"retune_advised"}, same, ultimate, ONCE, {}
    yield "load steps", {"disturbed"}, same, gains, STILL, {"loads": [LoadStep(at_s, load)]}
    yield "load and set point", {"disturbed"}, same, gains, STEPS, {"loads": [LoadStep(at_s, load)]}
    yield "a wave from outside", {"disturbed"}, same, gains, STILL, {"loads": wave}
    yield "play", {"valve_sticking"}, same, eager, ONCE, {"actuators": [Backlash(band)]}
    yield "sticks (Stenman)", {"valve_sticking"}, same, eager, ONCE, {"actuators": [Stiction(band)]}
    yield "sticks (He)", {"valve_sticking"}, same, eager, ONCE, {"actuators": [HeStiction(band, 0.4 * band)]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=100)
    args = parser.parse_args()
    told, right = {}, {}
    for seed in range(args.first, args.first + args.seeds):
        rng = np.random.default_rng(seed)
        T = 10.0 ** rng.uniform(0.0, 2.0)
        model = process.Fopdt(math.exp(rng.uniform(math.log(0.3), math.log(6.0))), T, T * rng.uniform(0.05, 1.5))
        period_s = ultimate_point(model).Pu
        for name, codes, plant, gains, moves, hidden in kinds(rng, model, period_s, PERIODS * period_s):
            recording = run(plant, gains, period_s, moves, seed, expected_K=model.K, **hidden)
            wide = {part: (0.98 * value, 1.02 * value) for part, value in model.parameters().items()}
            code = findings(recording, Expected(model, wide, gains)).code
            told.setdefault(name, Counter())[code] += 1
            right[name] = codes
    table = Table("loop", "right", *CODES, title=f"{args.seeds} loops of each kind")
    for name, counts in told.items():
        share = sum(counts[code] for code in right[name]) / args.seeds
        table.add_row(name, f"{share:.0%}", *(str(counts[code] or "") for code in CODES))
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
