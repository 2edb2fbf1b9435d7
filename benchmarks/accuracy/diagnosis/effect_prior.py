"""Whether a learned prior over effects helps the search of a diagnosis: with it and without it.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.accuracy.diagnosis.effect_prior [--train 9001 16] [--test 8001 2]

    P(effect | x) = softmax(W x + b),   x the features below, standardised

Multinomial logistic regression (Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2009, sec. 4.4),
trained on records of the independent generator with visible effects. Its features are what the process alone leaves:
misfit on both parts, autocorrelation, moments, spectrum, squares by quarter of the record, the shares that depend on
output, moves, direction, level, slope and time (`residual_dependence`); and the linearised score of each effect, which
the search computes anyway. Seeds: each meets every form once, experiments in turn. Those of training are not tested on.

order       how often the right effect is among the first k, by the search's linearised scores and by the prior
search      `diagnose` as it is, and with the prior: the effects that it puts first go on to every later stage of the
            search beside those that go on by their misfit. Nothing else changes: what is accepted is decided by the
            error on data that were not fitted. Right first, and processor time
confidence  the mean squared error of the reported confidence as a forecast of "right" (Brier, Mon. Weather Rev. 78,
            1950), and of logistic recalibrations by confidence alone, by prior alone, by both, each with the records
            left out ten times in turn
"""

from __future__ import annotations

import argparse
import math
import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import autotuner
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first, without_rounding
from autotuner.core.diagnosis.extended.fitting import ENOUGH_FOR_RANKS, fit
from autotuner.core.diagnosis.findings.residual_dependence import dependences
from autotuner.core.diagnosis.search import search, trace
from autotuner.core.diagnosis.search.judge import noise_of
from autotuner.core.diagnosis.search.screen import screened, tangent_of
from autotuner.errors import AutotunerError
from benchmarks.accuracy.cases.independent_effects import ALIKE, FORMS
from benchmarks.accuracy.diagnosis import independent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

FIRST = (1, 2, 3, 6, 9, 24)
LAGS = (1, 2, 4, 8, 16, 32)
SEATS = 3
"""Effects that the prior sends on beside those that go on anyway."""
STRENGTH, LEAST = 0.3, 1e-3
"""Inverse of the penalty on the regression's weights; least likelihood that counts."""
SURE = 0.999
EXTEND = search.extend


class Captured(Exception):  # noqa: N818 - it ends a diagnosis that has shown what is wanted
    """The first step of a search, and what it was given."""


@dataclass(frozen=True)
class Seen:
    """What the prior sees of a record, and the names that are right."""

    features: dict[str, float]
    right: frozenset[str]
    scores: dict[str, float] = field(default_factory=dict)


def cases(first: int, count: int) -> Iterator[independent.Case]:
    """Return a case of each form and seed, without those of the sensor: these are not searched for."""
    for seed in range(first, first + count):
        for k, (key, (name, *_)) in enumerate(FORMS.items()):
            if name not in independent.OF_THE_SENSOR:
                yield independent.Case(key, seed, independent.EXPERIMENTS[(seed + k) % len(independent.EXPERIMENTS)])


def right_names(case: independent.Case) -> frozenset[str]:
    return frozenset({FORMS[case.key][0], *ALIKE.get(case.key, ())})


def residual_features(context: Any, base: Any) -> dict[str, float]:
    """Return what the process alone leaves, in figures without unit."""
    noise = noise_of(context, base)
    rows = np.flatnonzero(context.dataset.fitted | context.dataset.held_out)
    left = context.dataset.data.pv[rows] - base.simulated(rows)
    z = (left - left.mean()) / max(float(left.std()), 1e-300)
    power = np.abs(np.fft.rfft(z)[1:]) ** 2
    return {
        "misfit": math.log(max(base.rms / noise, LEAST)),
        "elsewhere": math.log(max(context.held_out_error(base) / noise, LEAST)),
        "loop": float(context.dataset.in_loop),
        "shape": float(len(base.problem.structure.shape)),
        "kurtosis": min(float((z**4).mean()), 50.0),
        "skewness": float((z**3).mean()),
        "line": float(power.max() / power.sum()),
        "frequency": math.log1p(int(power.argmax())),
        "trend": abs(float(np.corrcoef(z, np.arange(z.size))[0, 1])),
        **{f"lag {k}": float((z[k:] * z[:-k]).mean()) for k in LAGS if k < z.size},
        **{f"quarter {k}": float((part**2).mean()) for k, part in enumerate(np.array_split(z, 4))},
        **{f"depends on {d.variable}": d.share for d in dependences(context, base, noise)},
    }


def scores_of(context: Any, tangents: Sequence[Any], effects: Sequence[Any]) -> tuple[dict[str, float], list[Any]]:
    """Return the best linearised score of each name, log of what it leaves of the squares; and all starts."""
    before = min(float(t.left @ t.left) / t.left.size for t in tangents)
    starts = [(effect.name, found) for effect in effects if (found := screened(context, tangents, effect)[0])]
    scores: dict[str, float] = {}
    for name, found in starts:
        scores[name] = min(scores.get(name, 0.0), math.log(max(found[0].score, 1e-300) / before))
    return scores, [found for _, found in starts]


def captured(case: independent.Case) -> Seen | None:
    """Return what a record shows at the first step of the search; None where there is nothing to search for."""

    def capture(context: Any, bases: Sequence[Any], effects: Sequence[Any]) -> None:
        scores, _ = scores_of(context, [tangent_of(context, base) for base in bases], effects)
        raise Captured(Seen(residual_features(context, bases[0]), right_names(case), scores))

    try:
        record = independent.record_of(case)
        if independent.linear_misfit(record) <= independent.VISIBLE:
            return None
        with patch.object(trace, "extend", capture):
            autotuner.diagnose(autotuner.Recording.from_csv_text(record.csv()))
    except Captured as found:
        seen: Seen = found.args[0]
        return seen
    except (AutotunerError, OverflowError):
        return None
    return None


class Prior:
    """The regression, with the order of its features."""

    def __init__(self, known: Sequence[tuple[str, Seen]]) -> None:
        self.names = sorted({name for _, seen in known for name in seen.scores})
        self.features = sorted({name for _, seen in known for name in seen.features})
        self.model: Any = make_pipeline(StandardScaler(), LogisticRegression(C=STRENGTH, max_iter=2000))
        self.model.fit([self.row(seen) for _, seen in known], [name for name, _ in known])

    def row(self, seen: Seen) -> np.ndarray:
        scores = np.array([seen.scores.get(name, 0.0) for name in self.names])
        return np.concatenate(([seen.features.get(n, 0.0) for n in self.features], scores, scores - scores.min()))

    def __call__(self, seen: Seen) -> dict[str, float]:
        """Return how likely each effect is, the likeliest first."""
        shares = dict(zip(self.model.classes_, self.model.predict_proba([self.row(seen)])[0].tolist(), strict=True))
        return dict(sorted(shares.items(), key=lambda item: -item[1]))


def order(seen: Sequence[Seen], prior: Prior) -> None:
    """Print how often the right effect is among the first ones."""
    print(f"| order | {' | '.join(f'first {k}' for k in FIRST)} |\n|{'---|' * (len(FIRST) + 1)}")
    orders: dict[str, Callable[[Seen], list[str]]] = {
        "linearised scores": lambda s: sorted(s.scores, key=lambda name: s.scores[name]),
        "learned prior": lambda s: list(prior(s)),
    }
    for title, of in orders.items():
        shares = [np.mean([bool(s.right & set(of(s)[:k])) for s in seen]) for k in FIRST]
        print(f"| {title} | {' | '.join(f'{share:.0%}' for share in shares)} |")


def with_seats(prior: Prior, told: list[dict[str, float]]) -> Callable[[Any, Any, Any], list[Any]]:
    """Return the first step of the search with the prior's first effects in every stage."""

    def kept(ranked: list[Any], count: int, favoured: list[str], name_of: Callable[[Any], str]) -> list[Any]:
        chosen = ranked[:count]
        there = {name_of(one) for one in chosen}
        more = [next((one for one in ranked if name_of(one) == name), None) for name in favoured if name not in there]
        return [*chosen, *(one for one in more if one is not None)]

    def extend(bench: Any, bases: Sequence[Any], effects: Sequence[Any]) -> list[Any]:
        if bases[0].problem.effects or len(effects) == 1:
            return EXTEND(bench, bases, effects)
        scores, starts = scores_of(bench, [tangent_of(bench, base) for base in bases], effects)
        likely = prior(Seen(residual_features(bench, bases[0]), frozenset(), scores))
        told.append(likely)
        favoured = list(likely)[:SEATS]
        to_quick, to_coarse, to_fine = search.FIRST
        ranked = kept(
            without_rounding(starts, lambda s: s[0].score),
            to_quick,
            favoured,
            lambda s: s[0].problem.effects[0].name,
        )
        by_name: Callable[[Any], str] = lambda c: c.names[0]  # noqa: E731
        tried = [[fit(s.problem, s.theta, search.QUICK_STEPS, ENOUGH_FOR_RANKS) for s in of] for of in ranked]
        quick = kept(closest_first([closest_first(of)[0] for of in tried]), to_coarse, favoured, by_name)
        again = [fit(_on(c, bench.coarse), c.theta, search.COARSE_STEPS, ENOUGH_FOR_RANKS) for c in quick]
        fine = [search.refined(bench, c) for c in kept(closest_first(again), to_fine, favoured, by_name)]
        return [c for c in closest_first(fine) if is_physical(c)]

    return extend


def _on(candidate: Any, rows: Any) -> Any:
    return replace(candidate.problem, rows=rows)


def compared(tested: Sequence[independent.Case], prior: Prior) -> list[tuple[float, float, bool]]:
    """Print right first and time of whole diagnoses; return confidence, likelihood and truth of the first effects."""
    rows, forecasts = [], []
    for case in tested:
        plain, told = independent.judged(case), list[dict[str, float]]()
        if not plain["visible"] or "s" not in plain:
            continue
        with patch.object(trace, "extend", with_seats(prior, told)):
            helped = independent.judged(case)
        rows.append((plain, helped))
        if plain["names"] and told:
            forecasts.append((plain["confidence"][0], told[0].get(plain["names"][0], LEAST), bool(plain["first"])))
    print("\n| search | records | right first | processor time |\n|---|---|---|---|")
    for title, column in (("as it is", 0), ("with the prior", 1)):
        found = [pair[column] for pair in rows]
        right = sum(bool(row.get("first")) for row in found)
        print(f"| {title} | {len(found)} | {right} | {sum(row['s'] for row in found):.0f} s |")
    lost = sum(bool(a.get("first")) and not b.get("first") for a, b in rows)
    print(f"\nright before and not with it: {lost}")
    return forecasts


def confidence(forecasts: Sequence[tuple[float, float, bool]]) -> None:
    """Print the Brier score of the reported confidence and of recalibrations."""
    reported, likelihood, right = (np.array(column) for column in zip(*forecasts, strict=True))
    odds = np.log(np.clip(reported, LEAST, SURE) / (1.0 - np.clip(reported, LEAST, SURE)))
    columns = np.column_stack((odds, np.log(likelihood + LEAST)))
    print(f"\n| forecast of {right.size} first effects, {right.mean():.0%} right | Brier score |\n|---|---|")
    print(f"| reported confidence | {np.mean((reported - right) ** 2):.3f} |")
    for title, used in (("by the confidence", [0]), ("by the prior", [1]), ("by both", [0, 1])):
        again = cross_val_predict(LogisticRegression(), columns[:, used], right, cv=10, method="predict_proba")[:, 1]
        print(f"| recalibrated {title} | {np.mean((again - right) ** 2):.3f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, nargs=2, default=(9001, 16), metavar=("FIRST", "SEEDS"))
    parser.add_argument("--test", type=int, nargs=2, default=(8001, 2), metavar=("FIRST", "SEEDS"))
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    known = [(FORMS[case.key][0], seen) for case in cases(*args.train) if (seen := captured(case)) is not None]
    prior = Prior(known)
    tested = [seen for case in cases(*args.test) if (seen := captured(case)) is not None]
    print(f"trained on {len(known)} records, tested on {len(tested)}\n", flush=True)
    order(tested, prior)
    confidence(compared(list(cases(*args.test)), prior))


if __name__ == "__main__":
    main()
