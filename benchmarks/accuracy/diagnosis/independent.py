"""Score `diagnose` on recordings of an independent generator.

    python benchmarks/accuracy/diagnosis/independent.py --seeds 2 --first 100
    python benchmarks/accuracy/diagnosis/independent.py --sections clean --noises white coloured heavy quantised
    python benchmarks/accuracy/diagnosis/independent.py --sections pairs --failures
    python benchmarks/accuracy/diagnosis/independent.py --only "ambient:free" --failures
    python benchmarks/accuracy/diagnosis/independent.py --sections single --plant integrating

The judges are the generator's own: the noise that it added, the effect that it hid, and whether a linear model that
this file fits by itself (two lags, dead time, gain, offset, initial state) misses by more than 1.5 of those sigmas.
`after` is the measured PV minus the simulated PV that the diagnosis returns, on the part of the record that it names
as its test, over the generator's sigma. `truth` is the same of the PV that the generator simulated: what an explanation
without any error leaves, with spikes and rounding of the sensor.

Of a pair, either effect has to be visible by itself. Intervals are those of the first effect's sizes, as far as the
generator has the same ones, and of the gain of the process beside it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import autotuner
from autotuner.errors import AutotunerError
from benchmarks.accuracy.cases.independent_effects import ALIKE, FORMS, PAIRS, Draw, slow_of, together
from benchmarks.accuracy.cases.independent_plants import Array, Hidden, Record, noise_of, plant_of, policy_of, run

EXPERIMENTS = ("relay", "steps", "random", "loop", "short")
NOISES = ("white", "coloured", "heavy", "quantised")
VISIBLE, VISIBLE_OF_A_SENSOR = 1.5, 1.2
"""Misfit of the best linear model, in sigmas, from which an effect counts as visible."""
OF_THE_SENSOR = {"sensor_quantisation", "outliers", "timing_jitter"}
NO_REST = ("output_quantisation", "time_proportioning")
"""Effects by which the actuator never has the output at which the generator begins."""
OF_WHAT_SETTLES = {"nonlinear_loss", "slow_mode", "inverse_response", "extra_lag", "recycle"}
"""Effects that the generator makes of the lags of a process which settles."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    key: str
    seed: int
    experiment: str
    noise: str = "white"
    plant: str | None = None

    @property
    def parts(self) -> list[str]:
        """Keys of the forms that are hidden: none, one, or the two of a pair."""
        return [key for key in self.key.split(" + ") if key in FORMS]


def record_of(case: Case, only: int | None = None) -> Record:
    """Return the recording of a case: the same for the same case, whatever else is run.

    With `only` it has but that one of the effects of a pair, as in the whole.
    """
    rng = np.random.default_rng([case.seed, zlib.crc32(f"{case.key}:{case.experiment}:{case.noise}".encode())])
    plant = plant_of(rng, case.plant)
    swing = float(rng.uniform(6.0, 15.0))
    motion = abs(plant.K) * swing * (slow_of(plant) if plant.kind == "integrating" else 1.0)
    dt = slow_of(plant) / float(rng.uniform(12.0, 30.0))
    n = int(rng.uniform(180, 300) if case.experiment == "short" else rng.uniform(600, 1100))
    sigma = motion * math.exp(rng.uniform(math.log(0.002), math.log(0.015)))
    hidden = Hidden()
    if case.parts:
        draw = Draw(plant, rng, swing, motion if case.experiment == "relay" else 2.0 * motion, n * dt)
        made = [FORMS[key][3](draw) for key in case.parts]
        hidden = made[only or 0] if len(made) == 1 or only is not None else together(made[0], made[1])
        named = [FORMS[key] for key in case.parts]
        name, kind = (" + ".join(words) for words in ([n for n, *_ in named], [k for _, k, *_ in named]))
        hidden = replace(hidden, name=name, form=kind, textbook=all(known for *_, known, _ in named))
    errors = noise_of("white" if case.noise == "quantised" else case.noise, sigma, n, rng)
    policy = policy_of(case.experiment, plant, rng, dt, swing, sigma, n)
    t, u, truth, y, sp = run(plant, hidden, policy, n, dt, errors, rng)
    y = y if hidden.sensor is None else hidden.sensor(y, rng)
    if case.noise == "quantised":
        y = 2.0 * sigma * np.round(y / (2.0 * sigma))
        sigma = math.hypot(sigma, 2.0 * sigma / math.sqrt(12.0))
    points = sp if np.isfinite(sp).all() else None
    return Record(t, u, y, points, truth, sigma, plant, hidden)


def linear_misfit(record: Record) -> float:
    """Return the root mean square that a second order with dead time leaves, in sigmas: this file's own fit.

    `T1` and `T2` are `n` and `m/n` of `m s^2 + n s + 1`, so that poles may be complex.
    """
    t, u, y = record.t, record.u - record.u[0], record.y
    dt = t[1] - t[0]

    def left(theta: Array) -> Array:
        T1, T2 = np.exp(np.clip(theta[:2], math.log(dt / 50.0), math.log(50.0 * t[-1])))
        d = float(np.clip(theta[2], 0.0, t[-1] / 3.0)) / dt
        k, part = int(d), d - int(d)
        whole, more = np.concatenate((np.zeros(k), u))[: u.size], np.concatenate((np.zeros(k + 1), u))[: u.size]
        late = whole * (1.0 - part) + more * part
        b, a, _ = scipy.signal.cont2discrete((np.ones(1), np.array([T1 * T2, T1, 1.0])), dt)
        answer = scipy.signal.lfilter(b.ravel(), a, late)
        free = scipy.signal.lfilter(np.ones(1), a, np.eye(t.size, 2), axis=0)
        columns = np.column_stack([answer, np.ones(t.size), free])
        return (y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) / record.sigma

    slow = slow_of(record.plant)
    found = math.inf
    for share, ratio in ((0.2, 0.3), (0.6, 0.3), (0.4, 2.0)):
        start = np.array([math.log(share * slow), math.log(ratio * share * slow), record.plant.D])
        best = scipy.optimize.least_squares(
            left, start, x_scale=np.array([1.0, 1.0, slow]), diff_step=np.full(3, 1e-4), max_nfev=40
        )
        found = min(found, math.sqrt(2.0 * best.cost / t.size))
    return found


def judged(case: Case) -> Row:
    """Return what the diagnosis says of a case, and whether that is right."""
    try:
        record = record_of(case)
    except OverflowError:  # this plant runs away with this effect: there is no record to judge
        return {"name": case.key, "visible": False, "verdict": "runs away", "noise": case.noise, "names": []}
    misfit = linear_misfit(record)
    row: Row = {
        "name": record.hidden.name,
        "form": record.hidden.form,
        "textbook": record.hidden.textbook,
        "experiment": case.experiment,
        "noise": case.noise,
        "seed": case.seed,
        "plant": record.plant.kind,
        "misfit": misfit,
        "pair": len(case.parts) > 1,
        "visible": is_visible(case, misfit),
        "names": [],
        "after": math.nan,
    }
    began = time.process_time()
    try:
        answer = autotuner.diagnose(autotuner.Recording.from_csv_text(record.csv()))
    except AutotunerError as error:
        return row | {"verdict": "refused", "why": str(error)[:160], "s": time.process_time() - began}
    except Exception as error:  # noqa: BLE001 - a crash is a result here
        return row | {"verdict": "crash", "why": repr(error)[:160], "s": time.process_time() - began}
    named = answer.effects
    alike = [right_names(key) for key in case.parts]
    meant = [{k for k, names in enumerate(alike) if names & {e.name, *e.indistinguishable}} for e in named]
    first = bool(meant and meant[0])
    traces = answer.traces
    assert traces is not None
    late = traces.t > traces.held_out_from_s
    off = traces.pv[late] - traces.after[late]
    return row | {
        "verdict": answer.verdict,
        "names": [e.name for e in named],
        "forms": [e.form for e in named],
        "confidence": [round(e.confidence, 3) for e in named],
        "first": first,
        "alone": first and len(named) == 1,
        "one": any(meant),
        "both": len(alike) == 2 and len(set().union(*meant)) == 2,
        "strange": [e.name for e, keys in zip(named, meant, strict=True) if not keys],
        "after": float(np.sqrt(np.mean(off**2))) / record.sigma,
        "truth": float(np.sqrt(np.mean((record.y - record.truth)[-np.count_nonzero(late) :] ** 2))) / record.sigma,
        "K": gain_and_interval(answer, record),
        "sizes": sizes_and_intervals(answer, record) if first else [],
        "s": round(time.process_time() - began, 2),
    }


def is_visible(case: Case, misfit: float) -> bool:
    """Return whether a linear model misses the record, and of a pair, either effect by itself."""
    parts = case.parts
    if len(parts) < 2:
        return misfit > threshold(*parts)
    return all(linear_misfit(record_of(case, k)) > threshold(key) for k, key in enumerate(parts))


def threshold(key: str = "") -> float:
    return VISIBLE_OF_A_SENSOR if key.partition(":")[0] in OF_THE_SENSOR else VISIBLE


def right_names(key: str) -> set[str]:
    return {FORMS[key][0], *ALIKE.get(key, ())}


def sizes_and_intervals(answer: autotuner.Diagnosis, record: Record) -> list[tuple[str, float, float, float, float]]:
    """Return the sizes of the first effect that the generator knows: name, value, ends of the interval, truth."""
    found, known = answer.effects[0], record.hidden.sizes
    names = [n for n in found.parameters if n in known and n in found.interval95]
    return [(n, found.parameters[n], *found.interval95[n], known[n]) for n in names]


def gain_and_interval(answer: autotuner.Diagnosis, record: Record) -> tuple[float, float, float, float] | None:
    """Return the gain of the process, the ends of its interval and the truth; None where either is not known."""
    plain: dict[str, Any] = answer.to_dict()
    model = plain["model"]["after"]
    if record.hidden.own_gain or answer.verdict not in {"explained", "adequate"} or "K" not in model:
        return None
    ends = model.get("interval95", {}).get("K")
    return None if ends is None else (model["K"], *ends, record.gain)


def cases_of(options: argparse.Namespace) -> list[Case]:
    experiments = options.experiments or EXPERIMENTS
    seeds = range(options.first, options.first + options.seeds)
    cases = []
    if "single" in options.sections:
        wanted = [key for key in FORMS if not options.only or any(part in key for part in options.only)]
        # Each form meets another experiment in each seed.
        order = {key: k for k, key in enumerate(FORMS)}
        cases += [Case(key, s, experiments[(s + order[key]) % len(experiments)]) for s in seeds for key in wanted]
    if "pairs" in options.sections:
        pairs = [
            " + ".join(pair) for pair in PAIRS if not options.only or any(o in k for o in options.only for k in pair)
        ]
        cases += [Case(key, s, experiments[(s + k) % len(experiments)]) for s in seeds for k, key in enumerate(pairs)]
    if "clean" in options.sections:
        for seed in seeds:
            for k, noise in enumerate(options.noises):
                for j, experiment in enumerate(experiments):
                    integrates = (seed + k + j) % 4 == 3 and experiment in {"relay", "loop", "short"}
                    cases.append(Case("clean", seed, experiment, noise, "integrating" if integrates else None))
    return (with_plant(cases, options.plant) if options.plant else cases)[:: options.thin]


def with_plant(cases: list[Case], kind: str) -> list[Case]:
    """Return the cases with plants of one kind, without the effects that such a plant cannot have."""
    unknown = OF_WHAT_SETTLES if kind == "integrating" else set()
    kept = [case for case in cases if not any(part.partition(":")[0] in unknown for part in case.parts)]
    return [replace(case, plant=kind) for case in kept]


def is_right(row: Row) -> bool:
    if row["name"] == "clean":
        return bool(row["verdict"] == "adequate")
    if row.get("pair"):
        return bool(not row["visible"] or (row.get("both") and not row["strange"]))
    return bool(row.get("alone") or not row["visible"])


def percent(rows: list[Row], holds: Any) -> float:
    return 100.0 * sum(map(bool, map(holds, rows))) / len(rows)


def is_wrong(row: Row, least: float = 0.0) -> bool:
    """Return whether a record is called explained by another name than its own."""
    wrong = row["verdict"] == "explained" and not row.get("first")
    return bool(wrong and max(row["confidence"], default=0.0) >= least)


def is_close(row: Row, by: str = "after") -> bool:
    return bool(row.get(by, math.nan) <= 1.1)


def is_its_name(row: Row) -> bool:
    """Return whether the first name is right by itself: not one that the record cannot separate from it."""
    return bool(row.get("first") and row["names"][0] in right_names(f"{row['name']}:{row['form']}"))


def is_alone_but_for_its_own(row: Row) -> bool:
    """Return whether every further name is true of the record, too: nobody hid it, but it is there.

    A plant of third order has a third lag. It begins at rest for the output that is asked for, which neither steps nor
    pulses of the actuator take.
    """
    return bool(row.get("first") and all(is_its_own(name, row) for name in row["names"][1:]))


def is_its_own(name: str, row: Row) -> bool:
    """Return whether a name is true of the record though nobody hid it."""
    own = {"extra_lag": row["plant"] == "third", "not_settled": any(name in row["name"] for name in NO_REST)}
    return own.get(name, False)


def has(verdict: str, row: Row) -> bool:
    return bool(row["verdict"] == verdict)


FIGURES = {
    "right first": lambda r: r.get("first"),
    "by that name": is_its_name,
    "alone": lambda r: r.get("alone"),
    "alone but for what the record has": is_alone_but_for_its_own,
    "explained": partial(has, "explained"),
    "by another name": is_wrong,
    "confidently so": partial(is_wrong, least=0.8),
    "adequate": partial(has, "adequate"),
    "refused": partial(has, "refused"),
    "crashed": partial(has, "crash"),
}


OF_PAIRS = {
    "both": lambda r: r.get("both"),
    "one of them": lambda r: r.get("one"),
    "a third": lambda r: r.get("strange"),
    "a third but for what the record has": lambda r: any(not is_its_own(name, r) for name in r.get("strange", ())),
    "explained": partial(has, "explained"),
}


OF_A_NORMAL_ERROR = 0.6745 / 1.96
"""Median of a normal error, in half-widths of its 95 % interval."""


def held(found: list[Any]) -> str:
    """Return in words how often 95 % intervals hold the truth, and the median error: also in half-widths of them."""
    inside = sum(low <= true <= high for _, low, high, true in found)
    error = float(np.median([abs(value / true - 1.0) for value, _, _, true in found]))
    off = float(np.median([2.0 * abs(value - true) / (high - low) for value, low, high, true in found if low < high]))
    share = f"{inside} of {len(found)} ({100.0 * inside / len(found):.1f} %)"
    medians = f"{100.0 * error:.2f} % and {off:.2f} half-widths ({OF_A_NORMAL_ERROR:.2f} of a normal error)"
    return f"{share}, error in the median {medians}"


def summary_of_pairs(rows: list[Row]) -> list[str]:
    seen = [r for r in rows if r.get("pair") and r["visible"]]
    if not seen:
        return []
    figures = ", ".join(f"{name} {percent(seen, holds):.1f} %" for name, holds in OF_PAIRS.items())
    return [f"pairs: {len(seen)} of which each is visible by itself", f"  {figures}"]


def summary_of_intervals(rows: list[Row]) -> list[str]:
    sizes = [tuple(size[1:]) for r in rows for size in r.get("sizes", ())]
    explained = [tuple(size[1:]) for r in rows if r["verdict"] == "explained" for size in r.get("sizes", ())]
    gains = [tuple(r["K"]) for r in rows if r.get("K") is not None]
    visible = [tuple(r["K"]) for r in rows if r.get("visible") and r.get("K") is not None]
    parts = (("sizes", sizes), ("sizes where explained", explained), ("gains K", gains), ("gains K, visible", visible))
    return [f"95 % intervals of {words} hold the truth: {held(found)}" for words, found in parts if found]


def summary(rows: list[Row]) -> list[str]:
    lines = []
    seen = [r for r in rows if r["name"] != "clean" and r["visible"] and not r.get("pair")]
    for title, textbook in (("textbook forms", True), ("other forms", False)):
        part = [r for r in seen if r["textbook"] == textbook]
        if not part:
            continue
        after = np.array([r["after"] for r in part if np.isfinite(r["after"])])
        seconds = [r["s"] for r in part]
        lines += [
            f"{title}: {len(part)} visible",
            "  " + ", ".join(f"{name} {percent(part, holds):.1f} %" for name, holds in FIGURES.items()),
            f"  after {np.median(after):.2f} sigmas in the median, 1.1 or less in {percent(part, is_close):.0f} %",
            f"  the truth itself leaves 1.1 or less in {percent(part, partial(is_close, by='truth')):.0f} %",
            f"  {np.median(seconds):.1f} s of processor time in the median, {max(seconds):.1f} s at most",
        ]
    explained = [r for r in seen if r["verdict"] == "explained"]
    far = sum(r["after"] > 2.0 for r in explained)
    lines.append(f"explained: {len(explained)}, more than 2 sigmas after: {far}")
    lines += [*summary_of_pairs(rows), *summary_of_intervals(rows)]
    for noise in NOISES:
        part = [r for r in rows if r["name"] == "clean" and r["noise"] == noise]
        if part:
            verdicts = dict(Counter(r["verdict"] for r in part))
            own = sum(r["plant"] == "third" and r["names"] == ["extra_lag"] for r in part)
            words = f", of which {own} with the plant's own third lag as extra_lag" if own else ""
            lines.append(f"nothing hidden, {noise} noise: {len(part)}: {verdicts}{words}")
    return lines


def told(row: Row) -> str:
    named = list(zip(row["names"], row.get("forms", []), row.get("confidence", []), strict=False))
    return (
        f"  {row['name']}:{row['form']} {row['experiment']} {row['plant']} seed {row['seed']} {row['noise']}: "
        f"{row['verdict']} {named} misfit {row['misfit']:.1f} after {row['after']:.2f} {row.get('why', '')}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--sections", nargs="+", default=["single", "clean"])
    parser.add_argument("--only", nargs="+", help="parts of name:form")
    parser.add_argument("--experiments", nargs="+")
    parser.add_argument("--noises", nargs="+", default=list(NOISES))
    parser.add_argument("--plant", help="kind of every plant: first, second, third, ringing, two_scales, integrating")
    parser.add_argument("--thin", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--failures", action="store_true", help="print every record that was not right")
    parser.add_argument("--save", type=Path, help="append the rows to a file of JSON lines")
    options = parser.parse_args()
    cases = cases_of(options)
    rows = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for row in pool.map(judged, cases) if options.jobs > 1 else map(judged, cases):
            rows.append(row)
            if options.save:
                with options.save.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row, default=float) + "\n")
            if options.failures and not is_right(row):
                print(told(row), flush=True)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
