"""Hidden physics: what the diagnosis says of recordings with effects in them that nobody declared.

    autotuner bench effects [--seeds 2] [--jobs 2] [--only backlash] [--sections single clean] [--save DIR]

Sections
    single    one effect: every form of the table, in two severities, on four kinds of plants, at SNR none/40/30/20 dB
    clean     nothing hidden: white, coloured and heavy-tailed noise
    pairs     two effects at once
    outside   physics that no catalogue has
    others    the same effects on records of other experiments
    thesis    plants of the thesis at 20 dB: clean, and with backlash of a tenth of the swing, from the whole record and
              from that of the relay alone
    speed     strong effects on records of about 3,000 samples: seconds of one core

Each seed draws plants, sizes, noise; `single` thins the SNR out to one a case unless `--all` is given. Every record is
one of the product's own tuning experiment, stepped against the simulator. Visible means: the best linear model of the
plant's own kind misses by more than 1.5 noise sigmas (see `_verdicts`). `--save` keeps records and answers.
"""

import argparse
import collections
import json
import math
import sys
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np

import autotuner
from autotuner.errors import AutotunerError
from autotuner_sim import Backlash, ColouredNoise, HeavyTailedNoise
from benchmarks.accuracy.cases._hidden import FORMS, OUTSIDE, PAIRS, Truth, form_of, textbook_form
from benchmarks.accuracy.cases._scenes import EXPERIMENTS, KINDS, NOTHING, H, Physics, RefusedError, scene
from benchmarks.accuracy.cases._verdicts import FLOOR, VISIBLE, base_residual, judge

DECIBELS = (math.inf, 40.0, 30.0, 20.0)
SECTIONS = ("single", "clean", "pairs", "outside", "others", "thesis", "speed")
LONG = 3000
"""Samples of a record in the section `speed`."""
NOISES = ("white", "coloured", "heavy")
TRIES = 4


@dataclass(frozen=True)
class Case:
    """A case by plain values, so that it can cross processes."""

    section: str
    forms: tuple
    kind: str
    severity: int
    decibel: float
    seed: int
    noise: str = "white"
    experiment: str = "tuning"

    @property
    def found(self):
        table = {(form.effect, form.label): form for form in (*FORMS, *OUTSIDE, TENTH)}
        return [table[key] for key in self.forms]

    @property
    def name(self):
        return "+".join(effect for effect, _ in self.forms) or "clean"

    @property
    def label(self):
        return "+".join(label for _, label in self.forms) or self.noise

    @property
    def textbook(self):
        return all(form.textbook for form in self.found)

    @property
    def scene(self):
        drawn = scene(self.kind, self.seed)
        return replace(drawn, dt=drawn.end_s / LONG) if self.section == "speed" else drawn

    @property
    def file(self):
        snr = "none" if math.isinf(self.decibel) else f"{self.decibel:g}dB"
        words = (self.section, self.name, self.label, self.kind, f"s{self.severity}", snr, self.noise, self.experiment)
        return "_".join((*words, str(self.seed))).replace(" ", "-")

    def generator(self, attempt=0):
        key = zlib.crc32(repr(replace(self, decibel=0.0, experiment="")).encode())
        return np.random.default_rng([key, self.seed, attempt])


TENTH = form_of(
    "backlash", "a tenth of the swing", lambda *_: (Physics(actuators=(Backlash(0.2 * H),)), {"width": 0.2 * H})
)


def sigma_of(case):
    return case.scene.spread * 10.0 ** (-case.decibel / 20.0)


def noise_of(case, sigma, seed):
    if case.noise == "coloured":
        return ColouredNoise(sigma, 3.0 * case.scene.dt, seed)
    return HeavyTailedNoise(sigma, 3.5, seed) if case.noise == "heavy" else None


def record(case, only=None):
    """Return recording and truth, or raise `RefusedError` when the experiment refuses every attempt.

    With `only` the record has but that one of the case's effects, the same as in the whole record.
    """
    for attempt in range(TRIES):
        rng = case.generator(attempt)
        physics, right, sizes, declared = NOTHING, (), {}, None
        for number, form in enumerate(case.found):
            hidden, truth = form.make(case.scene, case.severity, rng)
            physics = physics + hidden if only in (None, number) else physics
            right, declared = right + truth.right, truth.declared or declared
            sizes |= truth.sizes
        sigma, seed = sigma_of(case), int(rng.integers(2**31))
        try:
            recording = EXPERIMENTS[case.experiment](case.scene, physics, sigma, seed, noise_of(case, sigma, seed))
        except RefusedError:
            continue
        return recording, Truth(right, sizes, declared)
    raise RefusedError("every attempt")


def perform(case, save):
    """Return the judgement of one case; None when the experiment refused."""
    try:
        recording, truth = record(case)
    except RefusedError:
        return case, None
    noise = max(sigma_of(case), FLOOR * case.scene.spread)
    began_s = time.process_time()
    answer = answer_to(recording, truth.declared)
    seconds = time.process_time() - began_s
    base = base_residual(recording, case.scene, truth.declared)
    judged = judge(case, truth, answer, base, noise, seconds, len(recording))
    if case.section == "pairs":
        judged = replace(judged, each_visible=all(_shows(case, number, noise) for number in range(len(case.forms))))
    if save is not None:
        judged = replace(judged, saved=keep(case, recording, truth, answer, judged, save))
    return case, judged


def _shows(case, number, noise):
    """Return whether one of the effects alone would be visible; a record that is refused shows nothing."""
    try:
        recording, _ = record(case, number)
    except RefusedError:
        return False
    return base_residual(recording, case.scene) > VISIBLE * noise


def answer_to(recording, declared):
    """Return the diagnosis as JSON has it; a record that is refused gets the verdict `refused`."""
    try:
        return autotuner.diagnose(recording, model=declared).to_dict()
    except AutotunerError as error:
        return {"verdict": "refused", "effects": [], "error": {}, "model": {}, "notes": [str(error)]}


def keep(case, recording, truth, answer, judged, folder):
    """Write the record, its settings, the truth and the answer; return the path."""
    path = Path(folder) / case.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_name(path.name + ".csv").write_text(recording.to_csv(), encoding="utf-8")
    plant = {name: getattr(case.scene.plant, name) for name in case.scene.plant.__dataclass_fields__}
    told = {
        "right": truth.right,
        "sizes": truth.sizes,
        "plant": plant,
        "sigma": sigma_of(case),
        "base_over_noise": judged.base,
        "settings": dict(recording.settings),
        "declared": None if truth.declared is None else truth.declared.parameters(),
        "answer": answer,
    }
    path.with_name(path.name + ".json").write_text(json.dumps(told, indent=1, default=str), encoding="utf-8")
    return str(path) + ".csv"


def cases(options):
    """Return the cases that are asked for."""
    return [case for section in options.sections for case in _MAKE[section](options)]


def _singles(options, forms=FORMS, section="single"):
    for seed in range(options.first, options.first + options.seeds):
        for form in forms:
            for kind in form.kinds:
                for severity in (0, 1):
                    key = (form.effect, form.label)
                    pick = zlib.crc32(repr((key, kind, severity)).encode()) + seed
                    few = DECIBELS if options.all else (DECIBELS[pick % 4],)
                    yield from (Case(section, (key,), kind, severity, decibel, seed) for decibel in few)


def _clean(options):
    for seed in range(options.first, options.first + 5 * options.seeds):
        for kind in KINDS:
            for noise in NOISES:
                decibel = DECIBELS[1:][seed % 3]
                yield Case("clean", (), kind, 0, decibel, seed, noise)
            if seed < options.first + 2:
                yield Case("clean", (), kind, 0, math.inf, seed)


def _pairs(options):
    for seed in range(options.first, options.first + options.seeds):
        for number, names in enumerate(PAIRS):
            keys = tuple((name, textbook_form(name).label) for name in names)
            for kind in KINDS:
                yield Case("pairs", keys, kind, 1, DECIBELS[(seed + number) % 3], seed)


def _others(options):
    effects = dict.fromkeys(form.effect for form in FORMS)
    for seed in range(options.first, options.first + options.seeds):
        for number, effect in enumerate(effects):
            form = textbook_form(effect)
            kind = form.kinds[(seed + number) % len(form.kinds)]
            if effect in {"not_settled", "extra_lag", "inverse_response", "integrating"}:
                continue
            for experiment in EXPERIMENTS:
                yield Case("others", ((effect, form.label),), kind, 1, 40.0, seed, experiment=experiment)


def _speed(options):
    effects = dict.fromkeys(form.effect for form in FORMS if form.textbook)
    for seed in range(options.first, options.first + options.seeds):
        for number, effect in enumerate(effects):
            form = textbook_form(effect)
            kind = form.kinds[(seed + number) % len(form.kinds)]
            yield Case("speed", ((effect, form.label),), kind, 1, 40.0, seed)
        yield from (Case("speed", (), kind, 1, 40.0, seed) for kind in KINDS)


def _thesis(options):
    for seed in range(options.first, options.first + 3 * options.seeds):
        for keys in ((), ((TENTH.effect, TENTH.label),)):
            for experiment in ("tuning", "relay only"):
                yield Case("thesis", keys, "thesis", 1, 20.0, seed, experiment=experiment)


_MAKE = {
    "speed": _speed,
    "thesis": _thesis,
    "single": _singles,
    "clean": _clean,
    "pairs": _pairs,
    "outside": lambda options: _singles(options, OUTSIDE, "outside"),
    "others": _others,
}


def share(rows, what):
    rows = list(rows)
    return 100.0 * sum(map(what, rows)) / len(rows) if rows else math.nan


def middle(values):
    values = [value for value in values if not math.isnan(value)]
    return float(np.median(values)) if values else math.nan


def _is(verdict):
    return lambda r: r.verdict == verdict


def of_names(rows):
    """One line: how often the right name, exactly one, a wrong one."""
    return (
        f"{len(rows):5d} {share(rows, lambda r: r.first_right):6.1f} {share(rows, lambda r: r.only_right):6.1f} "
        f"{share(rows, lambda r: r.wrong):6.1f} {share(rows, lambda r: r.confidently_wrong):6.1f} "
        f"{share(rows, _is('unexplained')):6.1f} {share(rows, _is('adequate')):6.1f}"
    )


HEAD = f"{'':44} {'n':>5} {'first%':>6} {'one%':>6} {'wrong%':>6} {'conf.%':>6} {'unexp%':>6} {'adeq%':>6}"


def of_errors(rows):
    """One line: errors before and after; held out in sigmas, and intervals, on noisy records."""
    noisy = [r for r in rows if not math.isinf(r.decibel)]
    ratio = [r.held_before / r.held_after for r in rows if r.held_after > 0.0]
    met = share(noisy, lambda r: r.held_after <= 1.1)
    inside = [value for r in noisy for value in r.inside.values()]
    coverage = f"{100.0 * np.mean(inside):.0f} % of {len(inside)}" if inside else "-"
    return (
        f"{middle(r.held_before for r in noisy):8.2f} {middle(r.held_after for r in noisy):6.2f} {met:7.0f} "
        f"{middle(ratio):6.1f} {100.0 * middle(min(r.before, 9.99) for r in rows):9.1f} "
        f"{100.0 * middle(min(r.after, 9.99) for r in rows):8.1f}  {coverage}"
    )


ERROR_HEAD = (
    f"{'':30} {'held out, sigmas':>15} {'<=1.1 %':>7} {'ratio':>6} {'model before':>12} {'after %':>8}  intervals"
)


def print_single(rows):
    """Confusion, names and errors of single effects."""
    visible = [r for r in rows if r.visible]
    print(f"{len(rows)} records with one effect, {len(visible)} of them visible\n\n{HEAD}")
    for textbook, title in ((True, "textbook forms"), (False, "other forms")):
        print(f"{title:44} {of_names([r for r in visible if r.textbook is textbook])}")
    hidden = [r for r in rows if not r.visible]
    quiet = share(hidden, lambda r: r.first_right or not r.names)
    print(f"not visible: adequate, unexplained or right {quiet:.1f} % of {len(hidden)}\n")
    groups = collections.defaultdict(list)
    for r in visible:
        groups[r.effect, r.label, r.severity].append(r)
    for (effect, label, severity), group in sorted(groups.items()):
        print(f"{f'{effect}: {label}, {severity}':44} {of_names(group)}")
    print_confusion(visible)
    print(f"\n{ERROR_HEAD}")
    for effect in sorted({r.effect for r in visible}):
        for textbook, mark in ((True, ""), (False, " (other forms)")):
            group = [r for r in visible if r.effect == effect and r.textbook is textbook and r.first_right]
            if group:
                print(f"{effect + mark:34} {of_errors(group)}")
    for textbook, title in ((True, "all textbook forms"), (False, "all other forms")):
        print(f"{title:34} {of_errors([r for r in visible if r.textbook is textbook])}")


def print_confusion(rows):
    """What was named where: rows are the truth."""
    print("\nnamed first (truth: names with counts)")
    for effect in sorted({r.effect for r in rows}):
        seen = collections.Counter(r.names[0] if r.names else r.verdict for r in rows if r.effect == effect)
        added = collections.Counter(name for r in rows if r.effect == effect for name in r.names[1:])
        more = f"   added: {', '.join(f'{n} {c}' for n, c in added.most_common(4))}" if added else ""
        print(f"  {effect:24} {', '.join(f'{n} {c}' for n, c in seen.most_common())}{more}")


def print_clean(rows):
    print(f"\nclean records: adequate\n{'':12} {'n':>5} {'adequate %':>10}  names given")
    for noise in NOISES:
        group = [r for r in rows if r.label == noise]
        names = collections.Counter(name for r in group for name in r.names)
        adequate = share(group, lambda r: r.verdict == "adequate")
        print(f"{noise:12} {len(group):5d} {adequate:10.1f}  {dict(names)}")


def print_pairs(rows):
    print(f"\ntwo effects\n{'':44} {'n':>5} {'both%':>6} {'one%':>6} {'third%':>6}")
    groups = collections.defaultdict(list)
    for r in rows:
        groups[r.effect].append(r)
    each = [r for r in rows if r.each_visible]
    for name, group in [*sorted(groups.items()), ("all", rows), ("all whose parts are visible by themselves", each)]:
        shares = " ".join(f"{share(group, what):6.1f}" for what in (_both, _any, _third))
        print(f"{name:44} {len(group):5d} {shares}")


def _both(r):
    return all(name in r.names for name in r.effect.split("+"))


def _any(r):
    return bool({*r.names, *r.alike} & {*r.effect.split("+")})


def _third(r):
    return bool(set(r.names) - set(r.right))


def print_outside(rows):
    visible = [r for r in rows if r.visible]
    print(f"\noutside of the catalogue (first: the sensible nearest)\n{HEAD}")
    for effect in sorted({r.effect for r in visible}):
        print(f"{effect:44} {of_names([r for r in visible if r.effect == effect])}")
    print(f"{'all':44} {of_names(visible)}")
    print(f"unexplained or nearest {share(visible, lambda r: r.first_right or r.verdict == 'unexplained'):.1f} %")
    print_confusion(visible)


def print_others(rows):
    """What each kind of experiment can show."""
    print(f"\nother experiments, SNR 40 dB, strong effects\n{'':24} {'  '.join(f'{e:>14}' for e in EXPERIMENTS)}")
    by = {(r.effect, r.experiment): r for r in rows}
    for effect in sorted({r.effect for r in rows}):
        cells = [by.get((effect, experiment)) for experiment in EXPERIMENTS]
        print(f"{effect:24} {'  '.join(f'{_cell(r):>14}' for r in cells)}")
    for experiment in EXPERIMENTS:
        group = [r for r in rows if r.experiment == experiment]
        blind = [r for r in group if r.verdict == "adequate"]
        said = share(blind, lambda r: any("blind" in note for note in r.notes))
        print(
            f"{experiment:12} right first {share(group, lambda r: r.first_right):5.1f} %; adequate {len(blind)}, "
            f"of these with a note on what the record is blind to {said:.0f} %"
        )


def print_thesis(rows):
    """The thesis's noise case."""
    print("\nplants of the thesis, 20 dB: largest error of K, T, D")
    print(f"{'':34} {'n':>3} {'verdicts':38} {'before':>12} {'after':>7} {'worst':>7}")
    groups = collections.defaultdict(list)
    for r in rows:
        groups[r.effect, r.experiment].append(r)
    for (effect, experiment), group in groups.items():
        verdicts = collections.Counter(", ".join(r.names) or r.verdict for r in group)
        told = ", ".join(f"{name} {count}" for name, count in verdicts.items())
        before, after = middle(r.before for r in group), middle(r.after for r in group)
        print(
            f"{f'{effect}, {experiment}':34} {len(group):3d} {told:38} {100 * before:10.1f} % {100 * after:5.1f} % "
            f"{100 * max(r.after for r in group):5.1f} %"
        )


def print_speed(rows):
    """What records of many samples take."""
    print(f"\nrecords of about {LONG} samples: seconds of one core")
    for r in sorted(rows, key=lambda r: -r.seconds):
        print(f"{r.effect:24} {r.kind:12} {r.samples:6d} {r.seconds:7.2f}  {', '.join(r.names) or r.verdict}")
    seconds = np.array([r.seconds for r in rows])
    print(f"median {np.median(seconds):.2f} s, under 3 s {100.0 * np.mean(seconds < 3.0):.0f} %")


def _cell(r):
    if r is None:
        return "refused"
    mark = "right" if r.first_right else ("wrong" if r.wrong else r.verdict)
    return f"{mark}{'' if r.visible else ' (hidden)'}"


_PRINT = {
    "single": print_single,
    "clean": print_clean,
    "pairs": print_pairs,
    "outside": print_outside,
    "others": print_others,
    "thesis": print_thesis,
    "speed": print_speed,
}


def failures(results):
    """Return the cases whose answer is not the one asked for, as text."""
    for case, r in results:
        if r is None:
            continue
        bad = (
            bool(r.names)
            if case.section == "clean"
            else r.visible
            and not (all(name in r.names for name in r.effect.split("+")) if case.section == "pairs" else r.only_right)
        )
        if bad:
            yield (
                f"{r.base:7.1f}  {case.file:80} named {', '.join(r.names) or r.verdict} ({r.confidence:.2f}"
                f"{', alike ' + ' '.join(r.alike) if r.alike else ''})  {r.saved}"
            )


def watched(results, count):
    """Pass results on, and count them on a terminal."""
    for number, result in enumerate(results, 1):
        if sys.stderr.isatty():
            print(f"\r{number} of {count}", end="\n" if number == count else "", file=sys.stderr, flush=True)
        yield result


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", help="effects, by name")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--all", action="store_true", help="every SNR for every single effect")
    parser.add_argument("--thin", type=int, default=1, help="take about one case in so many")
    parser.add_argument("--save", type=Path, help="folder for the records and the answers")
    parser.add_argument("--failures", action="store_true", help="list the cases that fail")
    options = parser.parse_args(arguments)
    wanted = [c for c in cases(options) if not options.only or any(name in options.only for name, _ in c.forms)]
    wanted = [case for case in wanted if zlib.crc32(case.file.encode()) % options.thin == 0]
    parallel = joblib.Parallel(options.jobs, return_as="generator")
    results = list(watched(parallel(joblib.delayed(perform)(case, options.save) for case in wanted), len(wanted)))
    for section in options.sections:
        rows = [r for case, r in results if case.section == section and r is not None]
        if rows:
            _PRINT[section](rows)
    done = [r for _, r in results if r is not None]
    if done:
        seconds = np.array([r.seconds for r in done])
        print(
            f"\n{len(done)} diagnoses, {len(results) - len(done)} records refused by the experiment; "
            f"{np.median(seconds):.2f} s of one core a record (90 % under {np.quantile(seconds, 0.9):.2f} s, worst "
            f"{seconds.max():.2f} s) of {np.median([r.samples for r in done]):.0f} samples"
        )
    if options.failures:
        print("\nbase/noise  case  answer")
        print("\n".join(failures(results)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
