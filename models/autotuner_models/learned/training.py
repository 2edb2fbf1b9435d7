"""Networks for one structure, and for telling structures apart: scikit-learn trains them, arrays come out.

    1. spread   learns  log |truth - start|
    2. mean     learns  (truth - start)/s, clipped,  s = exp(spread + 0.635)
    3. rest     learns  log |truth - corrected|/s
    4. quantiles of |error|/se on experiments that were not trained on

Invariants: the seed decides everything; the last `HELD_OUT` of the batches is never trained on.
"""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from autotuner.core.identification.learned.correction import (
    CLASSES,
    LOG_NORMAL,
    Correction,
    Domain,
    LearnedModels,
    Networks,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from autotuner_models.learned.draw import Rowset

    Numbers = NDArray[np.float64]

HELD_OUT = 0.15
"""Share of the batches that is kept for calibration and tests."""
HIDDEN = (64, 64)
EPOCHS = 60
"""Most passes over the training rows, which bounds the time of a training."""
TINY = 1e-6
"""Error of a start under which it counts as none."""
CLIP = 5.0
"""Largest error, in standard errors of the start, that a model is trained on: beyond, the start failed."""
MARGIN = 0.02
"""Widening of a box, as a share of it."""
NARROWEST = 1e-5
"""Half width of the range of a feature that was constant in training: far more than its rounding."""
FARTHEST = 0.9995
"""Share of the training experiments within the distance of the domain."""
COMPARED_ROWS = 30_000
"""Rows on which features are compared: shares are then known to 0.3 %."""
NETWORK = "network"
"""The family that is shipped: it is kept as plain arrays, all others as scikit-learn's objects."""
SMALLEST_LEAF, TREES = 20, 60
"""Experiments in a leaf at least: an error is to be predicted, not remembered. Trees of a forest."""


class Pipeline(Protocol):
    """Interface of a scikit-learn pipeline of a scaler and a network, as used here."""

    def fit(self, X: Numbers, y: Numbers) -> Pipeline:
        """Learn."""

    def predict(self, X: Numbers) -> Numbers:
        """Return the predictions."""


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """Trained model of one structure: scikit-learn's pipelines, their arrays, and errors on unseen experiments."""

    pipelines: tuple[Pipeline, Pipeline, Pipeline]
    correction: Correction
    metrics: dict[str, object]


def network(seed: int, *, classes: bool = False) -> Pipeline:
    """Return an untrained network."""
    from sklearn.neural_network import MLPClassifier, MLPRegressor  # noqa: PLC0415 - only training needs it
    from sklearn.pipeline import make_pipeline  # noqa: PLC0415
    from sklearn.preprocessing import StandardScaler  # noqa: PLC0415

    kind = MLPClassifier if classes else MLPRegressor
    layers = kind(
        hidden_layer_sizes=HIDDEN,
        batch_size=512,
        max_iter=EPOCHS,
        alpha=1e-5,
        learning_rate_init=2e-3,
        random_state=seed,
    )
    made: Pipeline = make_pipeline(StandardScaler(), layers)
    return made


def _tree(seed: int) -> Pipeline:
    from sklearn.tree import DecisionTreeRegressor  # noqa: PLC0415 - only training needs it

    tree: Pipeline = DecisionTreeRegressor(min_samples_leaf=SMALLEST_LEAF, random_state=seed)
    return tree


def _forest(seed: int) -> Pipeline:
    from sklearn.ensemble import RandomForestRegressor  # noqa: PLC0415

    forest: Pipeline = RandomForestRegressor(
        TREES, min_samples_leaf=SMALLEST_LEAF, max_features=0.5, random_state=seed
    )  # fmt: skip
    return forest


def _linear(seed: int) -> Pipeline:
    from sklearn.linear_model import Ridge  # noqa: PLC0415
    from sklearn.pipeline import make_pipeline  # noqa: PLC0415
    from sklearn.preprocessing import StandardScaler  # noqa: PLC0415

    line: Pipeline = make_pipeline(StandardScaler(), Ridge(random_state=seed))
    return line


def _boosted(seed: int) -> Pipeline:
    from sklearn.ensemble import HistGradientBoostingRegressor  # noqa: PLC0415
    from sklearn.multioutput import MultiOutputRegressor  # noqa: PLC0415

    boosted: Pipeline = MultiOutputRegressor(HistGradientBoostingRegressor(random_state=seed))
    return boosted


FAMILIES: dict[str, Callable[[int], Pipeline]] = {
    NETWORK: network,
    "tree": _tree,
    "forest": _forest,
    "linear": _linear,
    "gradient_boosting": _boosted,
}
"""Families that can be trained, by name: the thesis's four, and gradient boosting."""


def train(rows: Rowset, seed: int, *, family: str = NETWORK, compare: bool = True) -> Trained:
    """Train the correction of one structure with a family; `compare` cross-validates others for the model card."""
    error = rows.truth - rows.start
    learn, judge = _split(error.shape[0])
    factory = FAMILIES[family]
    with _alone():
        spread = factory(seed).fit(rows.X[learn], np.log(np.abs(error[learn]) + TINY))
        size = np.exp(spread.predict(rows.X) + LOG_NORMAL)
        scaled = error / size
        mean = factory(seed + 1).fit(rows.X[learn], np.clip(scaled[learn], -CLIP, CLIP))
        residual = scaled - mean.predict(rows.X)
        error_size = factory(seed + 2).fit(rows.X[learn], np.log(np.abs(residual[learn]) + 1e-3))
    standardised = np.abs(residual[judge]) / np.exp(error_size.predict(rows.X[judge]))
    q68, q95 = np.quantile(standardised, (0.6827, 0.95), axis=0)
    pipelines = (spread, mean, error_size)
    answers = arrays_of(pipelines) if family == NETWORK else Regressors(pipelines)
    correction = Correction(answers, q68, q95 / q68, domain_of(rows.X[learn]), *box_of(rows.truth[learn]))
    metrics = _metrics(error[judge], (residual * size)[judge], standardised, (q68, q95))
    families = compared(rows, seed) if compare else {}
    return Trained(pipelines, correction, metrics | {"rows": int(error.shape[0]), "families": families})


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """Pipelines of any family side by side, with the interface of networks."""

    pipelines: tuple[Pipeline, ...]

    def __call__(self, x: Numbers) -> Numbers:
        """Return the outputs for rows (B, F), shape (M, B, P)."""
        return np.stack([pipeline.predict(x) for pipeline in self.pipelines])


class Classifier(NamedTuple):
    """The classifier of structures: scikit-learn's pipeline, arrays made of it, where it may be used, its hits."""

    pipeline: Pipeline
    networks: Networks
    domain: Domain
    right: dict[str, object]


def train_classifier(shapes: Mapping[str, Numbers], seed: int) -> Classifier:
    """Train the classifier of structures, in the order of `CLASSES`."""
    kinds = np.concatenate([np.full(shapes[name].shape[0], i) for i, name in enumerate(CLASSES)])
    X = np.concatenate([shapes[name] for name in CLASSES])
    judged = np.concatenate([_held_out(shapes[name].shape[0]) for name in CLASSES])
    with _alone():
        classifier = network(seed, classes=True).fit(X[~judged], kinds[~judged])
    right = classifier.predict(X[judged]) == kinds[judged]
    metrics: dict[str, object] = {name: float(right[kinds[judged] == i].mean()) for i, name in enumerate(CLASSES)}
    return Classifier(classifier, arrays_of((classifier,)), domain_of(X[~judged]), metrics)


def arrays_of(pipelines: tuple[Pipeline, ...]) -> Networks:
    """Return trained pipelines as arrays; their scaler becomes part of the first layer."""
    layers = [_layers(pipeline) for pipeline in pipelines]
    count = len(layers[0])
    return Networks(
        tuple(np.stack([layer[i][0] for layer in layers]) for i in range(count)),
        tuple(np.stack([layer[i][1][None, :] for layer in layers]) for i in range(count)),
    )


def _layers(pipeline: Pipeline) -> list[tuple[Numbers, Numbers]]:
    scaler, layers = (step for _, step in pipeline.steps)  # type: ignore[attr-defined]
    first = layers.coefs_[0] / scaler.scale_[:, None]
    offset = layers.intercepts_[0] - scaler.mean_ @ first
    for name in ("_optimizer", "_best_coefs", "_best_intercepts"):
        vars(layers).pop(name, None)  # most of its size, and no use but to train on
    return [(first, offset), *zip(layers.coefs_[1:], layers.intercepts_[1:], strict=True)]


def domain_of(X: Numbers) -> Domain:
    """Return where rows are: their box with a margin, and the distance that nearly all keep."""
    values, vectors = np.linalg.eigh(np.cov(X.T))
    whitening = vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))
    distance = np.linalg.norm((X - X.mean(axis=0)) @ whitening, axis=1)
    return Domain(*box_of(X), X.mean(axis=0), whitening, float(np.quantile(distance, FARTHEST)))


def box_of(X: Numbers) -> tuple[Numbers, Numbers]:
    """Return the least and the largest of each column, widened by a margin."""
    low, high = X.min(axis=0), X.max(axis=0)
    margin = MARGIN * (high - low) + NARROWEST
    return low - margin, high + margin


def compared(rows: Rowset, seed: int) -> dict[str, float]:
    """Return the cross-validated share of the start's error in its own spread that each family leaves, `mean z^2`."""
    from sklearn.ensemble import HistGradientBoostingRegressor  # noqa: PLC0415
    from sklearn.linear_model import Ridge  # noqa: PLC0415
    from sklearn.model_selection import cross_val_score  # noqa: PLC0415
    from sklearn.pipeline import make_pipeline  # noqa: PLC0415
    from sklearn.preprocessing import StandardScaler  # noqa: PLC0415

    X, error = rows.X[:COMPARED_ROWS], (rows.truth - rows.start)[:COMPARED_ROWS, 0]
    with _alone():
        size = np.exp(network(seed).fit(X, np.log(np.abs(error) + TINY)).predict(X) + LOG_NORMAL)
        z = np.clip(error / size, -CLIP, CLIP)
        families: dict[str, Callable[[], object]] = {
            "linear": lambda: make_pipeline(StandardScaler(), Ridge()),
            "boosted trees": lambda: HistGradientBoostingRegressor(random_state=seed),
            "network": lambda: network(seed),
        }
        scores = {
            name: cross_val_score(make(), X, z, cv=3, scoring="neg_mean_squared_error")
            for name, make in families.items()
        }
    return {name: float(-score.mean() / (z**2).mean()) for name, score in scores.items()}


def assembled(trained: Mapping[str, Trained], classifier: Networks, domain: Domain) -> LearnedModels:
    """Return everything in the form in which it is used."""
    return LearnedModels({name: one.correction for name, one in trained.items()}, classifier, domain)


@contextmanager
def _alone() -> Iterator[None]:
    """Train on one thread, which gives the same numbers on any machine, and mind no unconverged network.

    All epochs are used on purpose.
    """
    threadpoolctl = import_module("threadpoolctl")  # comes with scikit-learn

    with warnings.catch_warnings(), threadpoolctl.threadpool_limits(1):
        warnings.simplefilter("ignore")
        yield


def _metrics(before: Numbers, after: Numbers, over: Numbers, quantiles: tuple[Numbers, Numbers]) -> dict[str, object]:
    def of(error: Numbers) -> dict[str, list[float]]:
        size = np.abs(error)
        return {"median": np.median(size, axis=0).tolist(), "p95": np.quantile(size, 0.95, axis=0).tolist()}

    q68, q95 = quantiles
    normal = (over <= 1.96 * q68).mean(axis=0)
    return {
        "start": of(before),
        "corrected": of(after),
        "within_1_96_se": normal.tolist(),
        "q95_over_q68": (q95 / q68).tolist(),
    }


def _split(count: int) -> tuple[slice, slice]:
    edge = round((1.0 - HELD_OUT) * count)
    return slice(0, edge), slice(edge, count)


def _held_out(count: int) -> NDArray[np.bool_]:
    mask = np.zeros(count, dtype=np.bool_)
    mask[_split(count)[1]] = True
    return mask
