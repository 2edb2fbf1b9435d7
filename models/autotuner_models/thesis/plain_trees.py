"""Trees and forests as plain Python: written at training, read and evaluated without scikit-learn or NumPy.

A node is ``[feature, threshold, left, right]`` and a leaf ``[None, value, 0, 0]``, which is as long: so one step down a
tree takes apart what it comes to without asking what it is. A forest answers with the mean of its trees.
scikit-learn goes left where `float32(x) <= threshold`. That is `x <= edge`, with the edge half-way between the last
single-precision number not above the threshold and the next one, so nothing has to be rounded when a tree is evaluated.

Invariant: it imports nothing but the standard library, and of that neither `typing` nor `pathlib`, which take
as long as all the rest: so that a cold process answers at once.
"""

from __future__ import annotations

import json
import math
import struct

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike
    from pathlib import Path
    from typing import Any

    Node = Any
    """Four entries, the last two nodes unless the first is None."""


def as_plain(regressor: Any) -> list[Node]:
    """Return the trees of a fitted tree or forest of scikit-learn."""
    return [_node(one.tree_, 0) for one in getattr(regressor, "estimators_", [regressor])]


def _node(tree: Any, i: int) -> Node:
    if tree.children_left[i] < 0:
        return [None, float(tree.value[i].ravel()[0]), 0, 0]
    left, right = (_node(tree, int(children[i])) for children in (tree.children_left, tree.children_right))
    return [int(tree.feature[i]), _edge(float(tree.threshold[i])), left, right]


def _edge(threshold: float) -> float:
    """Return the largest number that single precision takes for one not above the threshold."""
    last = _single(threshold)
    last = _neighbour(last, -1) if last > threshold else last
    half_way = (last + _neighbour(last, 1)) / 2.0
    return half_way if _single(half_way) <= threshold else math.nextafter(half_way, -math.inf)


def _single(x: float) -> float:
    rounded: float = struct.unpack("<f", struct.pack("<f", x))[0]
    return rounded


def _neighbour(single: float, step: int) -> float:
    """Return the next single-precision number up (1) or down (-1)."""
    bits: int = struct.unpack("<i", struct.pack("<f", single or 0.0))[0]
    if single == 0.0:
        return step * float(struct.unpack("<f", struct.pack("<i", 1))[0])
    moved: float = struct.unpack("<f", struct.pack("<i", bits + (step if single > 0.0 else -step)))[0]
    return moved


def save_plain(path: Path, trees: list[Node]) -> None:
    """Write trees as JSON; numbers come back to the last bit."""
    path.write_text(json.dumps(trees), encoding="utf-8")


def load_plain(path: str | PathLike[str]) -> list[Node]:
    """Return the trees of a file."""
    with open(path, encoding="utf-8") as file:  # noqa: PTH123 - see the rule
        trees: list[Node] = json.load(file)
    return trees


def answer(trees: list[Node], row: Sequence[float]) -> float:
    """Return what the trees say of a row of features."""
    total = 0.0
    for feature, at, left, right in trees:
        while feature is not None:
            feature, at, left, right = left if row[feature] <= at else right  # noqa: PLW2901 - one step down
        total += at
    return total / len(trees)
