"""The learned correction against closed forms and least squares, on the same records, with the same static gain.

    python benchmarks/accuracy/estimates/learned.py [noise] [calibration] [--plants N] [--learned DIR] [--json FILE]
                                          [--markdown FILE]

noise        random plants of each structure, relay from rest read after 2, 5 and 8 half periods, white noise 40, 30,
             20 and 14 dB under the mean square of the oscillation, 100 samples a period: median and 95th percentile of
             the error, how many were answered, processor time of one estimate. A record's error is the largest of its
             parameters': m relative, other times over the sum of all, an integrator's K relative. The describing
             function is given the true dead time of a second-order process, the others find it
calibration  new experiments of all conditions of the training, of a seed of their own: how often one predicted standard
             error, and the 95 % interval, hold the truth; median error before and after the correction

The plants are simulated by `autotuner_sim`, which knows nothing of the tuner. All seeds are fixed; without a name all
are run. `noise` takes about four minutes with 40 plants.
"""

import argparse
import itertools
import json
import math
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.estimation.data import GainPrior, data_of
from autotuner.core.estimation.least_squares import fit
from autotuner.core.identification import measure_limit_cycle
from autotuner.core.identification.learned.correction import by_learned
from autotuner.core.identification.limit_cycle.from_cycle import Known, by_closed_form, by_describing_function
from autotuner.core.identification.limit_cycle.harmonic_start import COORDINATES
from autotuner.core.model.structures import FOPDT, INTEGRATING, SECOND_ORDER
from autotuner.core.recording import Recording
from autotuner.errors import InputError
from autotuner_models.learned.artefacts import SHIPPED, load
from autotuner_models.learned.draw import STRUCTURES, rows_of
from autotuner_sim import Fopdt, Integrating, Relay, SopdtOverdamped, SopdtUnderdamped, find_limit_cycle
from autotuner_sim.stepped import SteppedPlant

HALF_PERIODS = (2, 5, 8)
DECIBELS = (40.0, 30.0, 20.0, 14.0)
PER_PERIOD, REST = 100, 50
ON_SIGMA = 3.0
FITTED = {"fopdt": FOPDT, "integrating": INTEGRATING}
METHODS = ("describing_function", "closed_form", "learned", "least_squares")
SHOW = Console(width=150)


def plant_of(structure, rng):
    """Return a plant in the thesis's ranges: times 1 to 20 s, dead times 1 to 12 s, K 1 to 15; damping from 0.15."""
    K, D, first, second = (rng.uniform(*span) for span in ((1.0, 15.0), (1.0, 12.0), (1.0, 20.0), (1.0, 20.0)))
    if structure == "fopdt":
        return Fopdt(K, first, D)
    if structure == "sopdt_overdamped":
        return SopdtOverdamped(K, max(first, second), min(first, second), D)
    if structure == "sopdt_underdamped":
        return SopdtUnderdamped(K, first, 2.0 * rng.uniform(0.15, 0.95) * math.sqrt(first), D)
    return Integrating(K, second, D)


def record(plant, half_periods, decibels, seed):
    """Return the record of an asymmetric relay, -1 and 1.5, from rest: so many half periods between its switches."""
    cycle = find_limit_cycle(plant, Relay(-1.0, 1.0))
    sigma = cycle.peak / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    dt, rng, device, rows = cycle.period_s / PER_PERIOD, np.random.default_rng(seed), SteppedPlant(plant), []
    is_high, switched = True, 0
    while True:
        k = len(rows)
        device.advance(k * dt)
        pv = device.pv + sigma * rng.standard_normal()
        was = is_high
        if k > REST and abs(pv) > ON_SIGMA * sigma:
            is_high = pv < 0.0
        switched += is_high != was
        device.output = 0.0 if k < REST else 1.5 if is_high else -1.0
        rows.append((k * dt, device.output, pv))
        if switched > half_periods:
            return Recording(*np.array(rows).T, settings={"noise_sigma": sigma})


def estimators(models, structure, plant):
    """Return what is compared: each is given a recording and the static gain, and returns a model or None."""
    known, fitted = Known(plant.K, "given"), FITTED.get(structure, SECOND_ORDER)
    dead_time = plant if structure.startswith("sopdt") else None
    prior = GainPrior() if structure == "integrating" else GainPrior(plant.K)

    def by_fit(recording):
        candidate = fit(data_of(recording), fitted, prior)
        return None if candidate is None else candidate.model

    def by_df(recording):
        return by_describing_function(measure_limit_cycle(recording), known, dead_time, structure).model

    return {
        "describing_function": by_df,
        "closed_form": lambda recording: by_closed_form(measure_limit_cycle(recording), known, structure).model,
        "learned": lambda recording: by_learned(recording, structure, (plant.K, 0.0), models).model,
        "least_squares": by_fit,
    }


def as_polynomial(model):
    """Return K, m, n and D: one lag has no m; an integrator has its lag as n, and a K that is to be found."""
    p = {"T": 0.0} | {
        name: getattr(model, name) for name in ("K", "D", "T", "T1", "T2", "m", "n") if hasattr(model, name)
    }
    if "T1" in p:
        return p["K"], p["T1"] * p["T2"], p["T1"] + p["T2"], p["D"]
    return (p["K"], p["m"], p["n"], p["D"]) if "m" in p else (p["K"], 0.0, p["T"], p["D"])


def error_percent(model, plant):
    """Return the largest error of a parameter, %."""
    (K, m, n, D), (K0, m0, n0, D0) = as_polynomial(model), as_polynomial(plant)
    total = D0 + (2.0 * math.sqrt(m0) if m0 > 0.0 else n0)
    return 100.0 * max(abs(K / K0 - 1.0), abs(m / m0 - 1.0) if m0 else 0.0, abs(n - n0) / total, abs(D - D0) / total)


def judged(method, recording, plant):
    """Return the error and the processor time of one estimate, s."""
    begun = time.process_time()
    try:
        model = method(recording)
    except (InputError, ValueError):
        model = None
    spent = time.process_time() - begun
    return (math.inf if model is None else error_percent(model, plant)), spent


def noise(args, models):
    """Print the table of structures, half periods and noise."""
    cases = itertools.product(STRUCTURES, HALF_PERIODS, DECIBELS)
    rows = [row for case in cases for row in noise_rows(models, args.plants, *case)]
    title = "median / 95th percentile of the error, % (answered)"
    shown = Table("structure", "half periods", "dB", *METHODS, title=title)
    for i in range(0, len(rows), len(METHODS)):
        group = rows[i : i + len(METHODS)]
        best = min(row["median"] if row["answered"] > 0.5 else math.inf for row in group)
        cells = [("*" if row["median"] == best else "") + cell(row) for row in group]
        shown.add_row(group[0]["structure"], str(group[0]["half_periods"]), f"{group[0]['decibels']:g}", *cells)
    SHOW.print(shown)
    for name in METHODS:
        spent = np.median([row["ms"] for row in rows if row["method"] == name])
        SHOW.print(f"{name}: {spent:.2f} ms, median of medians")
    return rows


def noise_rows(models, plants, structure, half_periods, decibels):
    """Return what each method makes of the same records."""
    rng, errors, spent = np.random.default_rng(11), defaultdict(list), defaultdict(list)
    for seed in range(plants):
        plant = plant_of(structure, rng)
        recording = record(plant, half_periods, decibels, seed)
        for name, method in estimators(models, structure, plant).items():
            error, seconds = judged(method, recording, plant)
            errors[name].append(error)
            spent[name].append(seconds)
    rows = []
    for name in METHODS:
        found = np.array([error for error in errors[name] if math.isfinite(error)] or [math.nan])
        rows.append(
            {
                "structure": structure,
                "half_periods": half_periods,
                "decibels": decibels,
                "method": name,
                "median": float(np.median(found)),
                "p95": float(np.quantile(found, 0.95)),
                "answered": float(np.isfinite(errors[name]).mean()),
                "ms": 1e3 * float(np.median(spent[name])),
            }
        )
    return rows


def cell(row):
    """Return one cell of the table."""
    answered = "" if row["answered"] == 1.0 else f" ({100 * row['answered']:.0f} %)"
    return f"{row['median']:.3g} / {row['p95']:.3g}{answered}"


def calibration(args, models):
    """Print how often the predicted errors hold."""
    shown = Table(
        "structure", "coordinate", "within 1 se, %", "within 95 %, %", "median before, %", "after, %", "answered, %"
    )
    rows = []
    for i, structure in enumerate(STRUCTURES):
        parts = [rows_of(structure, 256, (1_000_003, i, chunk)) for chunk in range(max(1, args.plants // 4))]
        X, truth, begun = (np.concatenate([getattr(part, key) for part in parts]) for key in ("X", "truth", "start"))
        correction = models.corrections[structure]
        inside = np.array([correction.domain.beyond(x) <= 1.0 for x in X])
        values, errors = correction.apply(X[inside], begun[inside])
        over = np.abs(truth[inside] - values) / errors
        for j, coordinate in enumerate(COORDINATES[structure]):
            row = {
                "structure": structure,
                "coordinate": coordinate,
                "within_se": 100.0 * float((over[:, j] <= 1.0).mean()),
                "within_95": 100.0 * float((over[:, j] <= correction.q95[j]).mean()),
                "before": 100.0 * float(np.median(np.abs(truth - begun)[inside, j])),
                "after": 100.0 * float(np.median(np.abs(truth[inside] - values)[:, j])),
                "answered": 100.0 * float(inside.mean()),
            }
            rows.append(row)
            shown.add_row(structure, coordinate, *(f"{v:.3g}" for v in list(row.values())[2:]))
    SHOW.print(shown)
    return rows


def markdown(rows, plants):
    """Return the table of `noise` for the model card."""
    spent = {name: np.median([row["ms"] for row in rows if row["method"] == name]) for name in METHODS}
    lines = [
        "# The learned correction beside the other estimators",
        "",
        f"`python benchmarks/accuracy/estimates/learned.py noise --plants {plants}`:",
        "median / 95th percentile of a record's worst error, %; in brackets how many were answered; bold is the",
        "smallest median. Same records, static gain given; the describing function is given the true dead time of",
        "second-order processes too. Processor time of",
        "an estimate: " + ", ".join(f"{name.replace('_', ' ')} {ms:.1f} ms" for name, ms in spent.items()) + ".",
        "",
        "| structure | half periods | dB | " + " | ".join(name.replace("_", " ") for name in METHODS) + " |",
        "|---|---|---|" + "---|" * len(METHODS),
    ]
    for i in range(0, len(rows), len(METHODS)):
        group = rows[i : i + len(METHODS)]
        best = min(row["median"] if row["answered"] > 0.5 else math.inf for row in group)
        cells = [f"**{cell(row)}**" if row["median"] == best else cell(row) for row in group]
        cells = ["-" if row["answered"] == 0.0 else text for row, text in zip(group, cells, strict=True)]
        first = group[0]
        lines.append(
            f"| {first['structure']} | {first['half_periods']} | {first['decibels']:g} | {' | '.join(cells)} |"
        )
    return "\n".join(lines) + "\n"


PARTS = {"noise": noise, "calibration": calibration}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART")
    parser.add_argument("--plants", type=int, default=40)
    parser.add_argument("--learned", type=Path, default=SHIPPED, metavar="DIR", help="trained files")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table of `noise` there")
    args = parser.parse_args()
    models = load(args.learned)
    found = {name: PARTS[name](args, models) for name in (args.parts or PARTS)}
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if args.markdown is not None and "noise" in found:
        args.markdown.write_text(markdown(found["noise"], args.plants), encoding="utf-8")


if __name__ == "__main__":
    main()
