"""Training data in chunks: resumable, in parallel through joblib, on other machines through its Dask backend.

A chunk is the result of one seed, `(seed, structure, number)`, on any machine at any time. This process writes the
chunks to files and skips chunks that exist.

Sums of many numbers may differ in the last bit from one processor to the next. The training data, which is hashed, is
therefore rounded: features to single precision, coordinates to `DECIMALS`.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.application.computing.cluster import on_cluster
from autotuner.control.records.atomic_file import write_whole
from autotuner_models.learned.draw import STRUCTURES, Conditions, Rowset, rows_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

BATCH = 256
"""Experiments of a chunk."""
DECIMALS = 9
"""Decimals of a coordinate: more than any model resolves, fewer than platforms differ by."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Request: a seed, chunks of each structure, and the conditions of the experiments."""

    seed: int
    chunks: int
    given: Conditions = field(default_factory=Conditions)

    @property
    def key(self) -> str:
        """The mark of the files of these conditions; empty for the usual ones."""
        text = repr(self.given)
        return "" if self.given == Conditions() else f"-{hashlib.sha256(text.encode()).hexdigest()[:8]}"

    @property
    def experiments(self) -> int:
        """Number of experiments in all."""
        return BATCH * self.chunks * len(STRUCTURES)

    def parts(self) -> list[tuple[str, int]]:
        """Return structure and number of every chunk."""
        return [(structure, i) for i in range(self.chunks) for structure in STRUCTURES]


def generate(
    plan: Plan, folder: Path, jobs: int, dask: str | None, progress: Callable[[int, int], None]
) -> tuple[dict[str, Rowset], str]:
    """Make or read all chunks; return the rows by structure, and the SHA-256 of all of them in order."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = plan.parts()
    missing = [part for part in parts if not _path(folder, plan, part).exists()]
    done = len(parts) - len(missing)
    progress(done, len(parts))
    for part, made in _made(plan, missing, jobs, dask):
        _write(_path(folder, plan, part), made)
        done += 1
        progress(done, len(parts))
    chunks = {part: _read(_path(folder, plan, part)) for part in parts}
    digest = hashlib.sha256()
    for part in parts:
        for column in chunks[part]:
            digest.update(np.ascontiguousarray(column).tobytes())
    rows = {
        structure: Rowset(
            *(np.concatenate(c) for c in zip(*(chunks[structure, i] for i in range(plan.chunks)), strict=True))
        )
        for structure in STRUCTURES
    }
    return rows, digest.hexdigest()


def _made(
    plan: Plan, parts: list[tuple[str, int]], jobs: int, dask: str | None
) -> Iterator[tuple[tuple[str, int], Rowset]]:
    import joblib  # noqa: PLC0415 - only making needs it

    with on_cluster(dask):  # all of whose workers are used; it gives results back as a list only
        workers, kind = (-1, "list") if dask else (jobs, "generator_unordered")
        yield from joblib.Parallel(n_jobs=workers, return_as=kind)(
            joblib.delayed(_chunk)(plan.seed, part, plan.given) for part in parts
        )


def _chunk(seed: int, part: tuple[str, int], conditions: Conditions) -> tuple[tuple[str, int], Rowset]:
    structure, number = part
    return part, rows_of(structure, BATCH, (seed, STRUCTURES.index(structure), number), conditions)


def _path(folder: Path, plan: Plan, part: tuple[str, int]) -> Path:
    return folder / f"{part[0]}-{plan.seed}{plan.key}-{part[1]:04d}.npz"


def _write(path: Path, rows: Rowset) -> None:
    chunk = io.BytesIO()
    np.savez(chunk, **rows._asdict())
    write_whole(path, chunk.getvalue())


def _read(path: Path) -> Rowset:
    with np.load(path, allow_pickle=False) as arrays:
        rows = Rowset(*(arrays[name] for name in Rowset._fields))
    X, shape, scale = (column.astype(np.float32).astype(np.float64) for column in (rows.X, rows.shape, rows.scale))
    return Rowset(X, shape, rows.truth.round(DECIMALS), rows.start.round(DECIMALS), scale)
