"""Recordings: the samples of one experiment.

Rules of this file:

1. A recording is checked once, when it is made; nothing behind it checks again.
2. `output[k]` is the output commanded at `t[k]`, held until `t[k + 1]`; `pv[k]` is what was measured at `t[k]`, before
   the process can have answered that command.
3. A repair (a dropped row, a merged duplicate) leaves a note; nothing is repaired silently.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.recording_csv import parse_csv, render_csv
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from autotuner.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Sample:
    """One reading of a loop.

    Attributes
    ----------
    t : float
        Monotonic time of the read, s.
    pv : float
        Process variable, engineering units; NaN when the device could not vouch for it.
    output : float
        Output commanded from this sample on, output units.
    set_point : float
        Set point of the device, engineering units; NaN when unknown or when the loop is open.
    lateness_s : float
        How late the read was against its schedule, s.
    """

    t: float
    pv: float
    output: float
    set_point: float = float("nan")
    lateness_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The samples of one experiment, or of a historian.

    Attributes
    ----------
    t : array of float, shape (N,)
        Time, s, strictly increasing.
    output : array of float, shape (N,)
        Output commanded at `t[k]` and held until `t[k + 1]`, output units.
    pv : array of float, shape (N,)
        Process variable measured at `t[k]`, engineering units.
    set_point : array of float, shape (N,), or None
        Set point; NaN where the loop was open.
    extra : mapping of str to array of float, shape (N,)
        Further columns, by name: measured disturbances and the like.
    settings : mapping
        What is known of the experiment (relay levels, hysteresis, rest values), JSON-ready.
    notes : tuple of str
        What was repaired while reading.

    Raises
    ------
    RecordingError
        Unequal lengths, fewer than two samples, time not increasing, or a value that is not finite.
    """

    t: FloatArray
    output: FloatArray
    pv: FloatArray
    set_point: FloatArray | None = None
    extra: Mapping[str, FloatArray] = field(default_factory=lambda: MappingProxyType({}))
    settings: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("t", "output", "pv"):
            object.__setattr__(self, name, _column(name, getattr(self, name)))
        _check_lengths(self)
        _check_time(self.t)

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

    def window(self, start_s: float, end_s: float) -> Recording:
        """Return the samples with `start_s <= t <= end_s`."""
        keep = (self.t >= start_s) & (self.t <= end_s)
        return Recording(
            self.t[keep],
            self.output[keep],
            self.pv[keep],
            None if self.set_point is None else self.set_point[keep],
            {name: values[keep] for name, values in self.extra.items()},
            self.settings,
            self.notes,
        )

    @classmethod
    def from_samples(cls, samples: list[Sample], settings: Mapping[str, object] | None = None) -> Recording:
        """Make a recording of the samples of an experiment."""
        columns = np.array([(s.t, s.output, s.pv, s.set_point) for s in samples], dtype=np.float64).reshape(-1, 4)
        set_point = columns[:, 3] if np.isfinite(columns[:, 3]).any() else None
        return cls(columns[:, 0], columns[:, 1], columns[:, 2], set_point, settings=settings or {})

    @classmethod
    def from_csv_text(cls, text: str, name: str = "recording", columns: Mapping[str, str] | None = None) -> Recording:
        """Make a recording of a CSV text; `name` stands in error messages. The format is in `recording_csv`."""
        table = parse_csv(text, name, columns)
        return cls(table.t, table.output, table.pv, table.set_point, table.extra, notes=table.notes)

    @classmethod
    def from_csv(cls, path: str | PathLike[str], columns: Mapping[str, str] | None = None) -> Recording:
        """Read a CSV file; see `from_csv_text`. The one place where the core opens a file."""
        file = Path(path)
        try:
            text = file.read_text(encoding="utf-8-sig")
        except OSError as error:
            raise RecordingError(
                f"cannot be read: {error.strerror}", field=str(file), remedy="Check the path and its permissions."
            ) from error
        except UnicodeDecodeError as error:
            raise RecordingError(
                f"is not UTF-8 text (byte {error.start})", field=str(file), remedy="Save the file as CSV in UTF-8."
            ) from error
        return cls.from_csv_text(text, str(file), columns)

    def to_csv(self) -> str:
        """Return the recording as CSV text that `from_csv_text` reads back exactly."""
        return render_csv(self.t, self.output, self.pv, self.set_point, self.extra)


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
    column.flags.writeable = False
    return column


def _check_lengths(recording: Recording) -> None:
    size = recording.t.size
    if size < 2:
        raise RecordingError("needs two samples at least", field="t", value=size, remedy="Record for longer.")
    columns = {"output": recording.output, "pv": recording.pv, "set_point": recording.set_point, **recording.extra}
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
