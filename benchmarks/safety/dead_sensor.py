"""A sensor that freezes under the relay: how long until the output is released, and how far the PV went meanwhile.

    python benchmarks/safety/dead_sensor.py [--moments 40] [--seeds 3]

Processes from lag to dead time, a register of `STEP` whose noise is under its step (and none, and above it), and the
sensor frozen at moments spread over the relay, from its start on. Experiment and supervisor are those of a tuning; the
limits are `ROOM` amplitudes of the undisturbed oscillation away from it. Times are in samples.

    done       runs without a fault that end with a result; the watch must not take life for death
    ended      struck runs that ended
    no answer  longest time to the end, of those whose PV had moved by fewer than ten steps of the register before
    answered   the same of all others, in samples and in half periods of the undisturbed oscillation
    beyond     how far the true PV was beyond its limit at the end of the tuning, in amplitudes, at most
    own way    how far the process moved between the freezing and the end, in amplitudes, in that run

Required, exit code 1 otherwise: all are done, all end, `no answer` within the limit of the settings, `answered` within
`HALVES` half periods, and `beyond` less than `own way`.
"""

import argparse
import itertools
import math
import sys
from dataclasses import dataclass, field

import numpy as np

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Sample
from autotuner.core.safety.supervisor import SafetySettings, Supervisor
from autotuner_sim import Fopdt, Integrating, Noise, SopdtOverdamped, SteppedPlant

DT, STEP, OUTPUT0, PV0 = 0.1, 0.1, 40.0, 80.0
AMPLITUDE = 10.0
ROOM = 1.0
"""From the oscillation to the PV limit, in amplitudes."""
HALVES = 4.0
"""Longest time to the end of a tuning whose PV had answered, in half periods."""
FEW = 10.0
"""Steps of the register, beside the range of the noise, under which a PV counts as one that has not answered."""
LATE = 5
"""Samples after which a relay that decides by the median of several switches."""
LONGEST_S = 1200.0
NOISES = (0.0, 0.02, 0.05, 0.1)
PLANTS = {
    "lag, D/T 0.05": Fopdt(2.0, 20.0, 1.0),
    "D/T 0.15": Fopdt(2.0, 10.0, 1.5),
    "D/T 1": Fopdt(1.0, 3.0, 3.0),
    "dead time, D/T 10": Fopdt(0.6, 0.5, 5.0),
    "two lags": SopdtOverdamped(2.0, 8.0, 3.0, 1.0),
    "integrating": Integrating(0.05, 2.0, 1.0),
}


@dataclass
class Course:
    """What happened in a run."""

    code: str = "not ended"
    relay_s: float = math.nan
    t: list[float] = field(default_factory=list)
    true: list[float] = field(default_factory=list)
    switches: list[float] = field(default_factory=list)


def conduct(plant, noise, seed, *, pv_limits=(-math.inf, math.inf), frozen_s=math.inf):
    """Return the course of a tuning whose sensor freezes at a moment."""
    limits = Limits((0.0, 100.0), pv_limits)
    settings = ExperimentSettings(sample_time_s=DT, limits=limits, amplitude=AMPLITUDE, check=False)
    run, supervisor = (
        Experiment(settings, OUTPUT0),
        Supervisor(limits, SafetySettings(pv_timeout_s=1.0, max_lateness_s=1.0)),
    )
    loop = SteppedPlant(plant, output0=OUTPUT0, pv0=PV0, sensors=[Noise(noise, seed=seed)] if noise else [])
    course, output, phase, shown = Course(), OUTPUT0, Phase.QUIET, PV0
    for k in range(round(LONGEST_S / DT)):
        t = k * DT
        loop.advance(t)
        if t < frozen_s:
            shown = round(loop.measure() / STEP) * STEP
        course.t.append(t)
        course.true.append(loop.pv)
        sample = Sample(t, shown, output)
        if verdict := supervisor.check(sample, phase=phase):
            run.stop(verdict)
        command = run.step(sample)
        phase = command.phase
        if phase is Phase.RELAY and math.isnan(course.relay_s):
            course.relay_s = t
        if phase is Phase.RESTORE:
            course.code = run.verdict.code if run.verdict else "done"
            return course
        if command.output != output:
            course.switches.append(t)
        loop.output = output = command.output
    return course


@dataclass
class Row:
    """The worst of the struck runs of a plant."""

    ended: int = 0
    struck: int = 0
    silent_s: float = 0.0
    answered_s: float = 0.0
    beyond: float = -math.inf
    own_way: float = math.nan
    failed: list[str] = field(default_factory=list)

    def take(self, course, frozen_s, rest, limits, amplitude):
        """Take a struck run."""
        if course.t[-1] <= frozen_s:
            return
        self.struck += 1
        self.ended += course.code != "not ended"
        t, true = np.array(course.t), np.array(course.true)
        before, after = true[t <= frozen_s], true[t >= frozen_s]
        lasted_s = t[-1] - frozen_s
        if np.ptp(before) <= rest:
            self.silent_s = max(self.silent_s, lasted_s)
        else:
            self.answered_s = max(self.answered_s, lasted_s)
        beyond = max(limits[0] - after.min(), after.max() - limits[1]) / amplitude
        own_way = np.ptp(after) / amplitude
        if beyond > self.beyond:
            self.beyond, self.own_way = beyond, own_way
        if beyond > own_way:
            self.failed.append(f"beyond its limit by {beyond:.2g}, moved {own_way:.2g}")


def measure(plant, moments, seeds):
    """Return how many undisturbed runs ended with a result, and how the struck ones ended."""
    calm = conduct(plant, 0.0, 0)
    oscillating = np.array(calm.true)[np.array(calm.t) > calm.relay_s]
    low, high = oscillating.min(), oscillating.max()
    amplitude, half_s = (high - low) / 2.0, float(np.max(np.diff(calm.switches)))
    limits = low - ROOM * amplitude, high + ROOM * amplitude
    done, row = [], Row()
    for noise, seed in itertools.product(NOISES, range(seeds)):
        undisturbed = conduct(plant, noise, seed)
        done.append(undisturbed.code)
        for frozen_s in np.linspace(undisturbed.relay_s, undisturbed.t[-1], moments, endpoint=False):
            struck = conduct(plant, noise, seed, pv_limits=limits, frozen_s=frozen_s)
            row.take(struck, frozen_s, FEW * STEP + 6.0 * noise, limits, amplitude)
    return done, row, half_s


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    longest_s, failed = ExperimentSettings(sample_time_s=DT).longest_response_s, 0
    heads = f"{'no answer':>11}{'answered':>10}{'halves':>8}{'beyond':>8}{'own way':>9}"
    print(f"{'process':20}{'done':>8}{'ended':>10}{heads}")
    for name, plant in PLANTS.items():
        done, row, half_s = measure(plant, args.moments, args.seeds)
        count, halves = done.count("done"), row.answered_s / half_s
        judged = {
            "not all ended": row.ended < row.struck,
            "too late without an answer": row.silent_s > longest_s + LATE * DT,
            "too late": halves > HALVES,
        }
        wrong = [
            *row.failed,
            *(code for code in done if code != "done"),
            *(what for what, is_so in judged.items() if is_so),
        ]
        failed += bool(wrong)
        ended = f"{row.ended}/{row.struck}"
        print(
            f"{name:20}{f'{count}/{len(done)}':>8}{ended:>10}{row.silent_s / DT:11.0f}{row.answered_s / DT:10.0f}"
            f"{halves:8.1f}{row.beyond:8.2f}{row.own_way:9.2f}  {'; '.join(dict.fromkeys(wrong))}",
            flush=True,
        )
    print(f"{failed} not as required")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
