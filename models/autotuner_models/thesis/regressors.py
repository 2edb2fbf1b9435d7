"""The families of regressors of the thesis, and its protocol: 80:20 split, score on the 20.

    R2 = 1 - sum (y - y_pred)^2 / sum (y - mean y)^2

Seeds are the thesis's own: the split 1, the tree 2 (section 4.3.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

from autotuner_models.thesis.data_sets import GRID, OFF_GRID, OUT_OF_RANGE, data_set

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from autotuner_models.thesis.data_sets import DataSet

    Numbers = NDArray[np.float64]

SPLIT_SEED, MODEL_SEED = 1, 2


class Regressor(Protocol):
    """Interface of a scikit-learn regressor, as used here."""

    def fit(self, X: Numbers, y: Numbers) -> Regressor:
        """Learn."""

    def predict(self, X: Numbers) -> Numbers:
        """Return the prediction for each row."""


def _tree() -> Regressor:
    from sklearn.tree import DecisionTreeRegressor  # noqa: PLC0415 - scikit-learn only where something is trained

    tree: Regressor = DecisionTreeRegressor(random_state=MODEL_SEED)
    return tree


def _forest() -> Regressor:
    from sklearn.ensemble import RandomForestRegressor  # noqa: PLC0415

    forest: Regressor = RandomForestRegressor(random_state=MODEL_SEED)
    return forest


def _linear() -> Regressor:
    from sklearn.linear_model import LinearRegression  # noqa: PLC0415

    line: Regressor = LinearRegression()
    return line


def _network() -> Regressor:
    from sklearn.compose import TransformedTargetRegressor  # noqa: PLC0415
    from sklearn.neural_network import MLPRegressor  # noqa: PLC0415
    from sklearn.pipeline import make_pipeline  # noqa: PLC0415
    from sklearn.preprocessing import StandardScaler  # noqa: PLC0415

    layers = MLPRegressor(
        hidden_layer_sizes=(32, 32), solver="lbfgs", max_iter=600, max_fun=100_000, alpha=1e-3, random_state=MODEL_SEED
    )
    network: Regressor = TransformedTargetRegressor(
        make_pipeline(StandardScaler(), layers), transformer=StandardScaler()
    )
    return network


FAMILIES: dict[str, Callable[[], Regressor]] = {
    "tree": _tree,
    "forest": _forest,
    "linear": _linear,
    "network": _network,
}


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """One family on one data set and target.

    Attributes
    ----------
    truth, predicted : mapping of str to array of float
        By where the rows are from: ``train``, ``test``, ``off_grid``, ``out_of_range``.
    regressor : Regressor
        What was trained.
    """

    truth: dict[str, Numbers]
    predicted: dict[str, Numbers]
    regressor: Regressor

    def r2(self, where: str) -> float:
        """Return the score."""
        return r2(self.truth[where], self.predicted[where])

    def errors_percent(self, where: str) -> Numbers:
        """Return the relative errors, without sign."""
        return errors_percent(self.truth[where], self.predicted[where])


@cache
def trained(name: str, column: int, family: str, seed: int = 1) -> Trained:
    """Return a family trained on a data set of the thesis by its protocol; `column` 0 or 1 is the target.

    `seed` draws the rows of the grid; the thesis does not state which it drew.
    """
    import warnings  # noqa: PLC0415

    from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415
    from sklearn.model_selection import train_test_split  # noqa: PLC0415

    rows = grid_rows(name, seed)
    X, X_test, y, y_test = train_test_split(rows.X, rows.Y[:, column], test_size=0.2, random_state=SPLIT_SEED)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the score shows whether it went far enough
        regressor = FAMILIES[family]().fit(X, y)
    others = {where: other_rows(name, where) for where in (OFF_GRID, OUT_OF_RANGE)}
    inputs = {"train": X, "test": X_test} | {where: other.X for where, other in others.items()}
    truth = {"train": y, "test": y_test} | {where: other.Y[:, column] for where, other in others.items()}
    return Trained(truth, {where: regressor.predict(values) for where, values in inputs.items()}, regressor)


@cache
def grid_rows(name: str, seed: int) -> DataSet:
    """Return the rows of the thesis's grid that a seed draws."""
    return data_set(name, GRID, seed)


@cache
def other_rows(name: str, where: str) -> DataSet:
    """Return rows that are not on the grid, on which nothing is trained."""
    return data_set(name, where, seed=7)


def r2(truth: Numbers, predicted: Numbers) -> float:
    """Return the share of the variance that is predicted."""
    return 1.0 - float(((truth - predicted) ** 2).sum() / ((truth - truth.mean()) ** 2).sum())


def errors_percent(truth: Numbers, predicted: Numbers) -> Numbers:
    """Return the relative errors without sign, %."""
    errors: Numbers = 100.0 * np.abs(predicted / truth - 1.0)
    return errors
