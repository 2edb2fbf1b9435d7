"""How often the true loop is less robust than promised, when the model is only known within its errors.

    python benchmarks/uncertain_gains.py [--runs N]

For each of twelve processes a relay experiment is repeated with noise 20 dB under the mean square of the oscillation
(seeded), identified, and gains are designed twice: for the model alone, and over its 95 % region. Counted is how often
Ms of the true loop (by `loop_judge`) exceeds the target of 1.4. 200 runs take about half an hour.
"""

import argparse
import warnings

import numpy as np
from amigo_batch import Process, lag, ultimate
from loop_judge import iae, sensitivities
from relay_record import oscillation_rms, relay_record

from autotuner.core.tuning import Requirements, design
from autotuner.runtime.analysis import identified

TARGET, DECIBELS = 1.4, 20.0
INTEGRATOR = (0.0, 1.0)
PROCESSES = (
    Process("FOPDT D/T 0.1", "", 2.0, (), (lag(10),), 1.0),
    Process("FOPDT D/T 0.5", "", 2.0, (), (lag(10),), 5.0),
    Process("FOPDT D/T 2", "", 1.0, (), (lag(1),), 2.0),
    Process("FOPDT D/T 10", "", 1.0, (), (lag(1),), 10.0),
    Process("lags 10, 1; D 2", "", 1.0, (), (lag(10), lag(1)), 2.0),
    Process("lags 10, 2; D 4", "", 1.0, (), (lag(10), lag(2)), 4.0),
    Process("lags 7.5, 4.2; D 5", "", 1.5, (), (lag(7.5), lag(4.2)), 5.0),
    Process("lags 10, 8; D 0.5", "", 1.0, (), (lag(10), lag(8)), 0.5),
    Process("pair m 9, n 2.4; D 1", "", 1.0, (), ((1.0, 2.4, 9.0),), 1.0),
    Process("pair m 1, n 0.4; D 3", "", 1.0, (), ((1.0, 0.4, 1.0),), 3.0),
    Process("integrator; D 1", "", 0.1, (), (INTEGRATOR,), 1.0),
    Process("integrator, lag 3; D 1", "", 0.1, (), (INTEGRATOR, lag(3)), 1.0),
)


def true_loop(process, gains, Pu):
    """Return Ms (infinite when unstable) and error of the true loop."""
    numbers = (gains.Kp, gains.Ti, gains.Td, gains.Tf)
    Ms, _, stable = sensitivities(process, numbers, Pu)
    return (Ms if stable else np.inf), iae(process, numbers, Pu)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{'process':24s} {'runs':>5s} {'none':>5s} | {'model alone':^26s} | {'over its 95 % region':^26s}")
    columns = f"{'Ms > 1.4':>9s} {'Ms p97.5':>8s} {'IAE':>7s}"
    print(f"{'':36s} | {columns} | {columns}")
    totals = []
    for process in PROCESSES:
        Ku, Pu = ultimate(process)
        clean, _ = relay_record(process, Ku, Pu, 0.0, 0)
        sigma = oscillation_rms(clean) * 10.0 ** (-DECIBELS / 20.0)
        found, missed = [], 0
        for run in range(args.runs):
            record, _ = relay_record(process, Ku, Pu, sigma, run)
            found_out = None if record is None else identified(record).identification
            if found_out is None or found_out.model is None:
                missed += 1
                continue
            covariance = found_out.estimates[found_out.recommended].covariance
            plain = design(found_out.model).gains
            sure = design(found_out.model, Requirements(), covariance).gains if covariance is not None else plain
            found.append((*true_loop(process, plain, Pu), *true_loop(process, sure, Pu)))
        values = np.array(found)
        exceeded = [np.mean(values[:, i] > TARGET) for i in (0, 2)]
        totals.append(exceeded)
        best = np.median(values[:, 1])
        columns = [
            f"{100 * share:8.1f}% {np.percentile(values[:, i], 97.5):8.3f} {np.median(values[:, i + 1]) / best:7.3f}"
            for share, i in zip(exceeded, (0, 2), strict=True)
        ]
        print(f"{process.name:24s} {len(values):5d} {missed:5d} | {columns[0]} | {columns[1]}", flush=True)
    means = np.mean(totals, axis=0)
    print(f"{'mean':36s} | {100 * means[0]:8.1f}% {'':16s} | {100 * means[1]:8.1f}%")


if __name__ == "__main__":
    main()
