"""The array types that the core exchanges, and the number that keeps a division defined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SMALLEST_DIVISOR = 1e-300
"""Divisor, or argument of a logarithm, in place of 0: above the smallest normal double (2e-308), below any quantity."""
