"""The shipped networks without NumPy: for a process that must answer at once, or a machine that has Python alone.

    W2 relu(W1 relu(W0 x + b0) + b1) + b2        as in `autotuner.core.identification.learned.correction`

Invariant: it imports nothing but the standard library, and of that neither `typing` nor `pathlib`, which take
as long as all the rest; it reads the same file of arrays (see `artefacts`), and believes it on the same condition: that
the manifest vouches for it.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from array import array
from operator import mul
from os import PathLike, fspath

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    Layer = list[tuple[list[float], float]]
    """For each neuron its weights and its offset."""

MANIFEST, ARRAYS = "manifest.json", "learned.arrays"


def load_networks(folder: str | PathLike[str], name: str) -> list[list[Layer]]:
    """Return the networks of a structure, or `classes`, as layers of neurons.

    Raises
    ------
    ValueError
        The file is not the one that the manifest vouches for.
    """
    data = _read(folder, ARRAYS)
    if json.loads(_read(folder, MANIFEST))["sha256"][ARRAYS] != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{folder}/{ARRAYS} is not the file that its manifest vouches for")
    shapes, numbers = _unpacked(data)
    key = f"{name}/networks/"
    layers: list[list[Layer]] = []
    while f"{key}w{len(layers)}" in shapes:
        (shape, begin), (_, offsets) = (shapes[f"{key}{kind}{len(layers)}"] for kind in "wb")
        layers.append([_layer(numbers, shape, begin, offsets, m) for m in range(shape[0])])
    return [list(network) for network in zip(*layers, strict=True)]


def answers(networks: list[list[Layer]], row: Sequence[float]) -> list[list[float]]:
    """Return the outputs of each network for a row of features."""
    found = []
    for *hidden, last in networks:
        x: Sequence[float] = row
        for layer in hidden:
            x = [max(sum(map(mul, weights, x), offset), 0.0) for weights, offset in layer]
        found.append([sum(map(mul, weights, x), offset) for weights, offset in last])
    return found


def _read(folder: str | PathLike[str], name: str) -> bytes:
    with open(f"{fspath(folder)}/{name}", "rb") as file:  # noqa: PTH123 - see the rule
        return file.read()


def _unpacked(data: bytes) -> tuple[dict[str, tuple[list[int], int]], array[float]]:
    """Return shape and place of each array by name, and all numbers."""
    header, _, packed = data.partition(b"\n")
    numbers = array("d", packed)
    if sys.byteorder == "big":
        numbers.byteswap()
    shapes, at = {}, 0
    for name, shape in json.loads(header).items():
        shapes[name] = (shape, at)
        at += math.prod(shape)
    return shapes, numbers


def _layer(numbers: array[float], shape: list[int], begin: int, offsets: int, m: int) -> Layer:
    """Return the neurons of one layer of network `m`; weights lie by network, input and neuron."""
    _, inputs, outputs = shape
    first, end = begin + m * inputs * outputs, begin + (m + 1) * inputs * outputs
    return [(numbers[first + j : end : outputs].tolist(), numbers[offsets + m * outputs + j]) for j in range(outputs)]
