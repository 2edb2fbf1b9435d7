"""Recordings: the samples of one experiment.

Invariants:

1. A recording is validated once, when it is made; no later code validates it again.
2. `output[k]` is the output that follows `pv[k]`, measured at `t[k]`: it acts from `written_s[k]`, a moment between
   `t[k]` and `t[k + 1]`, or from `t[k]` where this time is unknown, until the next one acts.
3. A repair (a dropped row, a merged duplicate) leaves a note; nothing is repaired silently.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.recording.csv_text import decoded, parse_csv, render_csv
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from autotuner.core.model.arrays import BoolArray, FloatArray, IntArray


LARGEST = 1e60
"""Largest magnitude of a number: squares of larger ones overflow."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One reading of a loop.

    Attributes
    ----------
    t : float
        Monotonic time of the read, s.
    pv : float
        Process variable, engineering units; NaN when the device reports it as invalid.
    output : float
        Output commanded from this sample on, output units.
    set_point : float
        Set point of the device, engineering units; NaN when unknown or when the loop is open.
    lateness_s : float
        How late the read was against its schedule, s.
    written_s : float
        Time from which `output` acts when it was written for this sample, s; NaN where nothing was written.
    """

    t: float
    pv: float
    output: float
    set_point: float = float("nan")
    lateness_s: float = 0.0
    written_s: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Recording:
    """The samples of one experiment, or of a historian.

    Attributes
    ----------
    t : array of float, shape (N,)
        Time, s, strictly increasing.
    output : array of float, shape (N,)
        Output commanded after `pv[k]` was measured, output units.
    pv : array of float, shape (N,)
        Process variable measured at `t[k]`, engineering units.
    set_point : array of float, shape (N,), or None
        Set point; NaN where the loop was open.
    extra : mapping of str to array of float, shape (N,)
        Further columns, by name: measured disturbances and the like.
    settings : mapping
        Settings of the experiment (relay levels, hysteresis, rest values), JSON-ready.
    notes : tuple of str
        What was repaired while reading.
    written_s : array of float, shape (N,), or None
        Time from which `output[k]` acts, s, `t[k] <= written_s[k] <= t[k + 1]`; NaN becomes `t[k]`, and None is kept
        where that is so throughout.

    Raises
    ------
    RecordingError
        Unequal lengths, fewer than two samples, time not increasing, an output that acts before its sample or after
        the next one, or a value that is not finite or beyond anything measured.
    """

    t: FloatArray
    output: FloatArray
    pv: FloatArray
    set_point: FloatArray | None = None
    extra: Mapping[str, FloatArray] = field(default_factory=lambda: MappingProxyType({}))
    settings: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    notes: tuple[str, ...] = ()
    written_s: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("t", "output", "pv"):
            object.__setattr__(self, name, _column(name, getattr(self, name)))
        _check_lengths(self)
        _check_time(self.t)
        object.__setattr__(self, "written_s", _written(self.t, self.written_s))

    def __repr__(self) -> str:
        return f"<Recording {len(self)} samples, {self.duration_s:.4g} s>"

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t[-1] - self.t[0])

    @property
    def sample_interval_s(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def segments(self) -> Mapping[str, float]:
        """Time at which each part of an experiment begins, s, by the part's name; empty for another record."""
        segments = self.settings.get("segments")
        return segments if isinstance(segments, dict) else {}

    @property
    def acts_s(self) -> FloatArray:
        """Times from which the outputs act, s, shape (N,): `written_s`, or `t`."""
        return self.t if self.written_s is None else self.written_s

    def window(self, start_s: float, end_s: float) -> Recording:
        """Return the samples with `start_s <= t <= end_s`."""
        return self.part((self.t >= start_s) & (self.t <= end_s))

    def part(self, keep: slice | BoolArray | IntArray) -> Recording:
        """Return some of the samples: a slice, a mask or rising indices."""
        return Recording(
            self.t[keep],
            self.output[keep],
            self.pv[keep],
            None if self.set_point is None else self.set_point[keep],
            {name: values[keep] for name, values in self.extra.items()},
            self.settings,
            self.notes,
            None if self.written_s is None else self.written_s[keep],
        )

    @classmethod
    def from_samples(cls, samples: list[Sample], settings: Mapping[str, object] | None = None) -> Recording:
        """Make a recording of the samples of an experiment."""
        rows = [(s.t, s.output, s.pv, s.set_point, s.written_s) for s in samples]
        t, output, pv, set_point, written_s = np.array(rows, dtype=np.float64).reshape(-1, 5).T
        in_loop = set_point if np.isfinite(set_point).any() else None
        return cls(t, output, pv, in_loop, settings=settings or {}, written_s=written_s)

    @classmethod
    def from_csv_text(cls, text: str, name: str = "recording", columns: Mapping[str, str] | None = None) -> Recording:
        """Make a recording of a CSV text; error messages use `name`. The format is in `recording_csv`."""
        table = parse_csv(text, name, columns)
        return cls(
            table.t,
            table.output,
            table.pv,
            table.set_point,
            table.extra,
            notes=table.notes,
            written_s=table.written_s,
        )

    @classmethod
    def from_csv(cls, path: str | PathLike[str], columns: Mapping[str, str] | None = None) -> Recording:
        """Read a CSV file; see `from_csv_text`. The one place where the core opens a file."""
        file = Path(path)
        try:
            content = file.read_bytes()
        except OSError as error:
            raise RecordingError(
                f"cannot be read: {error.strerror}", field=str(file), remedy="Check the path and its permissions."
            ) from error
        return cls.from_csv_bytes(content, str(file), columns)

    @classmethod
    def from_csv_bytes(cls, content: bytes, name: str, columns: Mapping[str, str] | None = None) -> Recording:
        """Make a recording of a CSV file's bytes; UTF-8, UTF-16 or the Windows code page. See `from_csv_text`."""
        return cls.from_csv_text(decoded(content, name), name, columns)

    def to_csv(self) -> str:
        """Return the recording as CSV text that `from_csv_text` reads back exactly."""
        return render_csv(self.t, self.output, self.pv, self.set_point, self.extra, self.written_s)


def _column(name: str, values: object) -> FloatArray:
    column = np.array(values, dtype=np.float64)
    if column.ndim != 1:
        raise RecordingError(
            "must have one dimension", field=name, value=column.shape, remedy="Give one value a sample."
        )
    if not np.isfinite(column).all():
        row = int(np.flatnonzero(~np.isfinite(column))[0])
        raise RecordingError(
            f"is not a finite number in sample {row}",
            field=name,
            value=float(column[row]),
            remedy="Drop or repair that sample.",
        )
    if column.size and (largest := float(np.abs(column).max())) > LARGEST:
        raise RecordingError(
            "has numbers beyond anything that is measured",
            field=name,
            value=largest,
            remedy="Leave the cell empty for a missing reading.",
        )
    column.flags.writeable = False
    return column


def _check_lengths(recording: Recording) -> None:
    size = recording.t.size
    if size < 2:
        raise RecordingError("needs two samples at least", field="t", value=size, remedy="Record for longer.")
    columns = {
        "output": recording.output,
        "pv": recording.pv,
        "set_point": recording.set_point,
        "written_s": recording.written_s,
        **recording.extra,
    }
    for name, column in columns.items():
        if column is not None and column.size != size:
            raise RecordingError(
                f"has another length than t ({size})", field=name, value=column.size, remedy="Give one value a sample."
            )


def _check_time(t: FloatArray) -> None:
    backward = np.flatnonzero(np.diff(t) <= 0.0)
    if backward.size:
        row = int(backward[0]) + 1
        raise RecordingError(
            f"does not increase at sample {row}: {t[row - 1]:g} s is followed by {t[row]:g} s",
            field="t",
            value=float(t[row]),
            remedy="Sort the samples by time and drop repeated ones.",
        )


def _written(t: FloatArray, written_s: FloatArray | None) -> FloatArray | None:
    if written_s is None:
        return None
    acts_s: FloatArray = np.where(np.isnan(written_s), t, written_s)
    outside = np.flatnonzero((acts_s < t) | (acts_s > np.append(t[1:], np.inf)))
    if outside.size:
        row = int(outside[0])
        raise RecordingError(
            f"lies outside of sample {row}, which begins at {t[row]:g} s",
            field="written_s",
            value=float(acts_s[row]),
            remedy="Give each output the time at which it was written, between its sample and the next, or none.",
        )
    acts_s.flags.writeable = False
    return None if np.array_equal(acts_s, t) else acts_s
