"""Work on a Dask cluster through joblib, where one is given.

    with on_cluster("tcp://head:8786"):
        joblib.Parallel(...)(...)           on the workers of that cluster; without an address where it always ran

Invariant: the cluster gives the task of a lost worker to another one.
"""

from __future__ import annotations

import contextlib
from importlib import import_module
from typing import TYPE_CHECKING

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

CONNECT_S = 10.0
"""Longest wait for the scheduler, s."""


@contextlib.contextmanager
def on_cluster(address: str | None) -> Iterator[None]:
    """Let joblib work on a cluster inside the block.

    Parameters
    ----------
    address : str or None
        The scheduler; None changes nothing.

    Raises
    ------
    InputError
        No scheduler answers there, or the library is not installed.
    """
    if address is None:
        yield
        return
    import joblib  # noqa: PLC0415 - only those who have a cluster need it

    try:
        client = import_module("distributed").Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, ImportError) as error:
        raise InputError(
            f"cannot be used: {error}",
            field="--dask",
            value=address,
            remedy="Give the address of a scheduler that runs, and install relay-autotuner[dask].",
        ) from error
    with client, joblib.parallel_config(backend="dask"):
        yield
