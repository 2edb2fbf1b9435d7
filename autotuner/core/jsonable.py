"""JSON-ready copies of results: never NaN, never infinity."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np


def jsonable(value: object) -> object:
    """Return a copy of plain types: arrays as lists, complex numbers as pairs, what is not finite as None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return [jsonable(value.real), jsonable(value.imag)]
    if isinstance(value, Mapping):
        return {str(name): jsonable(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    return value
