"""Gains from relay experiments on the test batch, judged on the true processes against the optimum of each.

    python benchmarks/accuracy/tuning/batch.py [--levels none 40 30 20] [--every N]

For every process the product's own experiment is run, without noise and with noise 40, 30 and 20 dB under the mean
square of the oscillation, and its record is identified. Controllers are then judged on the true process by
`loop_judge`: error after a load step over that of the optimum (`data/optimum.csv`, Ms and Mt at most 1.4),
sensitivities, stability. The robust design and the rules use the same record. Seeded; takes about ten minutes.
"""

import argparse
import csv
import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from autotuner.application.analysis.basis import basis_of
from autotuner.application.analysis.procedure import identified
from autotuner.core.design import Requirements, UltimatePoint, apply_rule, design
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped
from autotuner.errors import InputError
from benchmarks.accuracy.cases.relay_record import oscillation_rms, relay_record
from benchmarks.baselines.amigo_batch import batch, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities

OPTIMA = Path(__file__).parents[2] / "baselines" / "data" / "optimum.csv"
RULES = (
    "ziegler_nichols_pid",
    "tyreus_luyben_pi",
    "tyreus_luyben_pid",
    "cohen_coon_pid",
    "simc_pi",
    "simc_pid",
    "amigo_pi",
    "amigo_pid",
    "lambda_pi",
    "lambda_pid",
)
FILTERED, IDEAL = Requirements(), Requirements(filter_ratio=math.inf)
COLUMNS = f"{'controller':24s} {'n':>4s} {'none':>5s} {'stable':>7s} {'median':>8s} {'p90':>8s} {'worst':>8s}"
COLUMNS += f" {'Ms p90':>7s} {'Ms max':>7s} {'Ms<=1.5':>8s} {'Ms<=1.6':>8s}"


def exact_model(process):
    """Return the process itself where a structure of the product holds it, else None."""
    lags = sorted((factor[1] for factor in process.denominator if factor[0] != 0.0), reverse=True)
    return {
        "P1": lambda: Fopdt(1.0, lags[0], process.D),
        "P2": lambda: SopdtOverdamped(1.0, lags[0], lags[1], process.D),
        "P6": lambda: Integrating(1.0, lags[0], process.D),
        "P7": lambda: SopdtOverdamped(process.gain, lags[0], lags[1], process.D),
    }.get(process.family, lambda: None)()


def judged(process, gains, Pu, optimum):
    """Return error over the optimum's, Ms, stable."""
    numbers = (gains.Kp, gains.Ti, gains.Td, gains.Tf)
    Ms, _, stable = sensitivities(process, numbers, Pu)
    return (iae(process, numbers, Pu) / optimum if stable else math.inf), (Ms if stable else math.inf), stable


def by_robust_design(process, model, Pu, optima, basis=None, least_dead_time=0.0):
    """Yield name and judgement of robust designs from a model, which gets the least dead time as in a tuning."""
    kinds = [("robust", FILTERED, "filtered", (model, None)), ("robust, no filter", IDEAL, "ideal", (model, None))]
    if basis is not None and basis.covariance is not None:
        kinds.append(("robust, 95 % region", FILTERED, "filtered", (basis.known_as or model, basis.covariance)))
    for name, requirements, kind, (known, region) in kinds:
        held = known if least_dead_time < known.D else replace(known, D=least_dead_time)
        yield name, judged(process, design(held, requirements, region).gains, Pu, optima[process.name, kind])


def by_rules(process, model, point, Pu, optima):
    """Yield name and judgement of the rules from a model and the measured ultimate point; None where one is refused."""
    for name in RULES:
        try:
            gains = apply_rule(name, model, point).gains
        except InputError:
            yield name, None
            continue
        yield name, judged(process, gains, Pu, optima[process.name, "filtered"])


def from_relay(process, level, optima, sigma):
    """Return judgements by name from one experiment, and its oscillation."""
    Ku, Pu = ultimate(process)
    record, verdict = relay_record(process, Ku, Pu, sigma, seed=level or 0)
    if record is None:
        return {"refused": verdict.code}, 0.0
    analysis = identified(record)
    model = analysis.identification.model
    if model is None:
        return {"refused": analysis.identification.verdict.code}, 0.0
    cycle = analysis.identification.limit_cycle
    point = None if cycle is None else UltimatePoint(cycle.Ku, cycle.Pu)
    half_s = record.sample_interval_s / 2.0
    found = dict(by_robust_design(process, model, Pu, optima, basis_of(analysis.identification), half_s))
    found.update(by_rules(process, model, point, Pu, optima))
    return found, oscillation_rms(record)


def summary(name, results, count):
    """Return a line of the table."""
    known = [r for r in results if r is not None]
    if not known:
        return f"{name:24s} {0:4d}"
    ratio, Ms = np.array([r[0] for r in known]), np.array([r[1] for r in known])
    stable = np.array([r[2] for r in known])
    finite = np.where(np.isfinite(ratio), ratio, 1e9)
    shown = [
        f"{np.percentile(finite, q):8.3f}" if np.percentile(finite, q) < 1e8 else "       -" for q in (50, 90, 100)
    ]
    peaks = [f"{np.percentile(np.where(stable, Ms, 99.0), q):7.3f}" for q in (90, 100)]
    shares = [f"{100.0 * np.mean(Ms <= limit):7.1f}%" for limit in (1.5, 1.6)]
    return (
        f"{name:24s} {len(known):4d} {count - len(known):5d} {100.0 * np.mean(stable):6.1f}% "
        f"{' '.join(shown)} {' '.join(peaks)} {' '.join(shares)}"
    )


def table(title, rows, count, worst=()):
    print(f"\n{title}\n{COLUMNS}")
    for name, results in rows.items():
        print(summary(name, results, count))
    for line in worst:
        print(line)
    sys.stdout.flush()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--levels", nargs="*", default=["none", "40", "30", "20"], help="noise under the oscillation, dB"
    )
    parser.add_argument("--every", type=int, default=1, help="take every n-th process")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with OPTIMA.open() as file:
        optima = {(row["process"], row["controller"]): float(row["IAE"]) for row in csv.DictReader(file)}
    processes = batch()[:: args.every]
    known = [(p, exact_model(p)) for p in processes if exact_model(p) is not None]
    rows = {}
    for process, model in known:
        for name, result in by_robust_design(process, model, ultimate(process)[1], optima):
            rows.setdefault(name, []).append(result)
    table("model known exactly (P1, P2, P6, P7)", rows, len(known))
    sizes = {}
    for level in args.levels:
        decibels = None if level == "none" else float(level)
        rows, notes = {}, []
        for process in processes:
            sigma = 0.0 if decibels is None else sizes.get(process.name, 0.0) * 10.0 ** (-decibels / 20.0)
            found, size = from_relay(process, 0 if decibels is None else int(decibels), optima, sigma)
            sizes.setdefault(process.name, size)
            if "refused" in found:
                notes.append(f"  {process.name}: refused, {found['refused']}")
                continue
            for name, result in found.items():
                rows.setdefault(name, []).append(result)
            error, Ms, _ = found["robust"]
            if error > 1.1 or Ms > 1.5:
                notes.append(f"  {process.name}: error {error:.3f} of the optimum, Ms {Ms:.3f}")
        noise = "without noise" if decibels is None else f"with noise at {decibels:g} dB"
        table(f"model from a relay experiment {noise}", rows, len(processes), notes)


if __name__ == "__main__":
    main()
