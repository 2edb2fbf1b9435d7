"""A rig of a stranger by `autotuner.run`: its physics in one thread, its fieldbus, which is slow, in another.

    python benchmarks/latency/threaded_rig.py [--runs N] [--period-s S]

The fieldbus holds each output for up to `--period-s`, unknown to the tuner: half of that is dead time. Printed are
model and gains of each run beside those of the true process. A machine that is busy makes the threads of the rig late,
and the rig another plant: run it alone.
"""

import argparse
import threading

import numpy as np

import autotuner
from autotuner.control.clock.ticker import clock

K, T, D = 2.0, 3.0, 0.4


class Rig:
    """A heater whose output is carried over every `period_s` only."""

    def __init__(self, period_s, seed):
        self.period_s = period_s
        self.wanted = self.output = 40.0
        self.pv, self.noise = 80.0, np.random.default_rng(seed)
        self.ended = threading.Event()
        self.threads = [threading.Thread(target=work) for work in (self.physics, self.fieldbus)]

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        for thread in self.threads:
            thread.join()

    def physics(self):
        then, moved = clock(), [(-1e9, 40.0)]
        while not self.ended.wait(0.005):
            now = clock()
            moved.append((now, self.output))
            while len(moved) > 1 and moved[1][0] <= now - D:
                moved.pop(0)
            self.pv += (now - then) / T * (K * moved[0][1] - self.pv)
            then = now

    def fieldbus(self):
        while not self.ended.wait(self.period_s):
            self.output = self.wanted

    def read(self):
        return self.pv + self.noise.normal(0.0, 0.05)

    def write(self, output):
        self.wanted = output


def shown(result):
    model = "none" if result.model is None else f"{result.model.structure} {result.model.parameters()}"
    gains = "none" if result.gains is None else f"Kp {result.gains.Kp:.3g} Ti {result.gains.Ti:.3g} s"
    found = "" if result.diagnosis is None else result.diagnosis.summary
    return f"{result.verdict.code}: {model}; {gains}; {found}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--period-s", type=float, default=0.25)
    args = parser.parse_args()
    right = autotuner.design(autotuner.Fopdt(K, T, D + args.period_s / 2.0), sample_time_s=0.1).gains
    print(f"right: K {K} T {T} D {D + args.period_s / 2.0}; Kp {right.Kp:.3g} Ti {right.Ti:.3g} s")
    for seed in range(args.runs):
        with Rig(args.period_s, seed) as rig:
            result = autotuner.run(rig.read, rig.write, output=40.0, sample_time_s=0.1)
        print(f"{seed} {shown(result)}; output {rig.wanted}", flush=True)
