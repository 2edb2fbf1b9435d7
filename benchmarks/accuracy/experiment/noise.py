"""Noise: what the experiment makes of plants with a noisy PV, and what two common rules make of the same records.

    python benchmarks/accuracy/experiment/noise.py [--seeds 40] [--sigmas 0 1 2 5 10] [--jobs 2]

For each plant of the batch and sigma of 0, 1, 2, 5, 10 % of the amplitude of its oscillation: the share of runs that
finish, the errors of Ku and Pu against the plant's own (median, worst), the switches that were needed. Ours are those
of the model that is identified from the record at the moment at which the experiment stops. The rules see the record
of the same run, which goes on under the same relay for them, up to 40 periods:

    last 12 peaks          stops at the twelfth peak; Ku, Pu from the mean of these twelve
    5 % amplitude spread   stops when the last four swings differ by 5 % at most; Ku, Pu from these four

with peaks the extremes between two switches, and Ku = 4 h / (pi A). Written here after what they are known for. Their
errors without noise are those of the describing function, which a rule for stopping cannot help.

Required, exit code 1 otherwise: at 5 % all runs finish, with median errors of Ku and Pu within 5 %; and everywhere at
least as many finished runs and no larger median errors than either rule.
"""

import argparse
import cmath
import math
import sys
import zlib
from dataclasses import replace
from itertools import pairwise

import joblib
import numpy as np
from scipy.optimize import brentq

from autotuner.application.computing.estimator import FEWEST_HALF_PERIODS
from autotuner.core.design.rules.ultimate import ultimate_point
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.relay import Relay
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.identification import identify, running_model
from autotuner.core.recording import Recording, Sample
from autotuner_sim import Noise, SteppedPlant
from benchmarks.accuracy.cases._plants import AMPLITUDE, BATCH, OUTPUT0, PV0

SIGMAS = (0.0, 0.01, 0.02, 0.05, 0.10)
LONGEST_PERIODS = 40
NAMES = ("ours", "last 12 peaks", "5 % amplitude spread")


def true_point(plant):
    """Return Ku and Pu of a plant from its frequency response."""

    def lag(w):
        """Phase beyond -180 degrees, without the jumps of the argument: the dead time is taken out first."""
        undelayed = plant.transfer(1j * w) * cmath.exp(1j * w * plant.D)
        return cmath.phase(undelayed) % (-2.0 * math.pi) - w * plant.D + math.pi

    w = brentq(lag, 1e-4, math.pi / plant.D)
    return 1.0 / abs(plant.transfer(1j * w)), 2.0 * math.pi / w


class Loop:
    """A plant under test, sampled; remembers what it was given."""

    def __init__(self, batch_plant, sigma, seed):
        sensors = [Noise(sigma, seed)] if sigma else []
        self.plant = SteppedPlant(
            batch_plant.plant, output0=OUTPUT0, pv0=PV0, sensors=sensors, output_limits=(0.0, 100.0)
        )
        self.dt, self.samples = batch_plant.sample_s, []

    def sample(self):
        t = len(self.samples) * self.dt
        self.plant.advance(t)
        return Sample(t, self.plant.measure(), self.plant.output)

    def hold(self, sample, output):
        self.plant.output = output
        self.samples.append(replace(sample, output=output))


def experiment(loop):
    """Run the experiment as the runtime does, the running model after each half period included."""
    settings = ExperimentSettings(sample_time_s=loop.dt, amplitude=AMPLITUDE, check=False)
    run = Experiment(settings, OUTPUT0)
    while run.phase is not Phase.RESTORE:
        sample = loop.sample()
        command = run.step(sample)
        if run.phase is not Phase.RESTORE:
            loop.hold(sample, command.output)
        if command.estimate is not None and command.estimate.half_period >= FEWEST_HALF_PERIODS:
            seen = run.settings_so_far()
            model = running_model(Recording.from_samples(loop.samples, seen), seen["noise_sigma"])
            run.inform(model.relative_error if model is not None else math.inf)
    return run


def our_result(loop, run):
    """Return how our run ended, and Ku, Pu and switches if it has a result."""
    if run.verdict is not None:
        return run.verdict.code, None
    identification = identify(Recording.from_samples(loop.samples, run.settings_so_far()))
    if identification.model is None:
        return identification.verdict.code, None
    point = ultimate_point(identification.model)
    switches = int(np.count_nonzero(np.diff([s.output for s in relay_part(loop, run)])))
    return "done", (point.Ku, point.Pu, switches)


def relay_part(loop, run):
    return [s for s in loop.samples if s.t >= run.segments.get("relay", math.inf)]


def go_on(loop, run, periods):
    """Let the relay run on for the rules."""
    seen = run.settings_so_far()
    relay = Relay(seen["relay_low"], seen["relay_high"], seen["relay_reference"], seen["hysteresis"])
    is_high, switches = loop.samples[-1].output > relay.bias, 0
    longest = int(periods * 20.0 * (BATCH_PERIOD_S[loop.plant.plant] / loop.dt))
    while switches < 2 * periods and len(loop.samples) < longest:
        sample = loop.sample()
        now_high = relay.switched(is_high=is_high, pv=sample.pv)
        switches += now_high != is_high
        is_high = now_high
        loop.hold(sample, relay.level(is_high=is_high))


BATCH_PERIOD_S = {one.plant: true_point(one.plant)[1] for one in BATCH}


def peaks_of(rows):
    """Return time and value of the extreme PV between each two switches, and half the swing of the output there."""
    switched = [k for k in range(1, len(rows)) if rows[k].output != rows[k - 1].output]
    peaks = []
    for first, last in pairwise(switched):
        falling = rows[first].output < rows[first - 1].output
        best = max(rows[first:last], key=lambda s, sign=1.0 if falling else -1.0: sign * s.pv)
        peaks.append((best.t, best.pv, abs(rows[first].output - rows[first - 1].output) / 2.0))
    return peaks


def by_peaks(peaks):
    """Return Ku and Pu of the mean of some peaks."""
    t, pv, h = np.array(peaks).T
    amplitude = float(np.abs(np.diff(pv)).mean()) / 2.0
    return 4.0 * float(h.mean()) / (math.pi * amplitude), float((t[2:] - t[:-2]).mean())


def last_twelve(peaks):
    """Return Ku, Pu and switches of the rule, or None when it does not finish."""
    return (*by_peaks(peaks[:12]), 13) if len(peaks) >= 12 else None


def spread(peaks):
    """Return Ku, Pu and switches of the rule, or None when it does not finish."""
    pv = [peak[1] for peak in peaks]
    swings = np.abs(np.diff(pv))
    for end in range(4, len(swings) + 1):
        last = swings[end - 4 : end]
        if last.max() - last.min() <= 0.05 * last.mean():
            return (*by_peaks(peaks[end - 4 : end + 1]), end + 2)
    return None


def perform(index, share, seed, amplitude):
    """Return, for ours and for each rule, Ku and Pu errors and switches; None where it does not finish."""
    one = BATCH[index]
    number = int(np.random.default_rng([seed, index, zlib.crc32(str(share).encode())]).integers(2**31))
    loop = Loop(one, share * amplitude, number)
    run = experiment(loop)
    code, ours = our_result(loop, run)
    if "relay_low" in run.settings_so_far():
        go_on(loop, run, LONGEST_PERIODS)
    peaks = peaks_of(relay_part(loop, run))
    Ku, Pu = true_point(one.plant)
    results = (ours, last_twelve(peaks), spread(peaks))
    return index, share, code, [r and (abs(r[0] / Ku - 1.0), abs(r[1] / Pu - 1.0), r[2]) for r in results]


def amplitude_of(index):
    """Return the amplitude of the undisturbed oscillation."""
    loop = Loop(BATCH[index], 0.0, 0)
    run = experiment(loop)
    pv = np.array([s.pv for s in relay_part(loop, run)])
    last = pv[pv.size // 2 :]
    return float(last.max() - last.min()) / 2.0


def summary(rows):
    """Return share finished, median and worst errors in %, median switches; of one cell and one method."""
    done = np.array([row for row in rows if row is not None], float).reshape(-1, 3)
    if not done.size:
        return {
            "finished": 0,
            "runs": len(rows),
            "Ku": math.inf,
            "Pu": math.inf,
            "worst": math.inf,
            "switches": math.nan,
        }
    Ku, Pu, switches = done.T
    return {
        "finished": len(done),
        "runs": len(rows),
        "Ku": 100.0 * float(np.median(Ku)),
        "Pu": 100.0 * float(np.median(Pu)),
        "worst_Ku": 100.0 * float(Ku.max()),
        "worst_Pu": 100.0 * float(Pu.max()),
        "switches": float(np.median(switches)),
    }


def not_met(cells):
    """Return what is required and was not reached, as text."""
    found = []
    for (index, share), methods in cells.items():
        ours, *others = methods
        place = f"{BATCH[index].name}, sigma {100 * share:g} %"
        if share == 0.05 and ours["finished"] < ours["runs"]:
            found.append(f"{place}: {ours['finished']} of {ours['runs']} finished")
        if share == 0.05 and max(ours["Ku"], ours["Pu"]) > 5.0:
            found.append(f"{place}: median Ku {ours['Ku']:.1f} %, Pu {ours['Pu']:.1f} %")
        for name, other in zip(NAMES[1:], others, strict=True):
            behind = [key for key in ("Ku", "Pu") if ours[key] > other[key]]
            behind += ["finished"] if ours["finished"] < other["finished"] else []
            found += [f"{place}: {key} {ours[key]:.2f} behind {name} {other[key]:.2f}" for key in behind]
    return found


def table(cells):
    """Return one row a cell and method."""
    rows = [f"{'plant':22} {'sigma':>6}  {'method':22} {'finished':>9} {'Ku %':>12} {'Pu %':>12} {'switches':>8}"]
    for (index, share), methods in cells.items():
        for name, m in zip(NAMES, methods, strict=True):
            ku = f"{m['Ku']:.2f} / {m['worst_Ku']:.1f}" if m["finished"] else "-"
            pu = f"{m['Pu']:.2f} / {m['worst_Pu']:.1f}" if m["finished"] else "-"
            rows.append(
                f"{BATCH[index].name:22} {100 * share:5g}%  {name:22} {m['finished']:4d}/{m['runs']:<4d} "
                f"{ku:>12} {pu:>12} {m['switches']:8.0f}"
            )
    return "\n".join(rows)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument(
        "--sigmas", type=float, nargs="+", default=[100.0 * share for share in SIGMAS], metavar="PERCENT"
    )
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)
    parallel = joblib.Parallel(options.jobs)
    amplitudes = parallel(joblib.delayed(amplitude_of)(index) for index in range(len(BATCH)))
    shares = [sigma / 100.0 for sigma in options.sigmas]
    seeds = {share: range(options.seeds if share else 1) for share in shares}  # without noise all runs are the same
    work = [(i, share, seed) for i in range(len(BATCH)) for share in shares for seed in seeds[share]]
    done = parallel(joblib.delayed(perform)(i, share, seed, amplitudes[i]) for i, share, seed in work)
    cells = {}
    for index, share, _, errors in done:
        cells.setdefault((index, share), []).append(errors)
    cells = {key: [summary(column) for column in zip(*rows, strict=True)] for key, rows in cells.items()}
    print("errors: median / worst")
    print(table(cells))
    refusals = sorted({(BATCH[i].name, share, code) for i, share, code, _ in done if code != "done"})
    for name, share, code in refusals:
        count = sum(BATCH[i].name == name and s == share and c == code for i, s, c, _ in done)
        print(f"refused  {name}, sigma {100 * share:g} %: {code} {count}")
    missed = not_met(cells)
    for line in missed:
        print(f"NOT MET  {line}")
    print(f"{len(done)} runs; {len(missed)} requirements not met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
