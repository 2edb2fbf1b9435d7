"""Threads of the linear algebra libraries: one a process.

The matrices of this package have a few columns. Threads of a library of linear algebra cost such computations more than
they save, and take the cores from the loops and from the workers, of which there is one a core. The libraries read
these variables when they are loaded, so `use_one_thread` is called before numpy is imported. What a user has set stays.
"""

from __future__ import annotations

import os

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""The variables that OpenBLAS, OpenMP, MKL and Accelerate read."""


def use_one_thread() -> None:
    """Set the variables that are not set; processes started afterwards inherit them."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
