"""Long CSV recordings of plain numbers, read as a block: ten million rows in bounded time and memory.

Anything that is not plain numbers throughout (an empty cell, a stamp, a repeated or earlier time) is left to the
reading cell by cell, which can say what is wrong where.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.csv_text import is_number, read_sheet
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from autotuner.core.arrays import FloatArray
    from autotuner.core.csv_text import Sheet

LONG = 50_000
"""Lines from which a text is read so."""
MOST_LINES = 50_000_000
HEAD = 20_000
"""Characters that the header is looked for in."""


def read_head(text: str, name: str) -> Sheet | None:
    """Return header and first rows of a long text; None for one that is read cell by cell."""
    lines = text.count("\n")
    if lines < LONG:
        return None
    if lines > MOST_LINES:
        raise RecordingError(
            f"has more than {MOST_LINES} lines", field=name, value=lines, remedy="Thin it out or give a part of it."
        )
    end = text.rfind("\n", 0, HEAD)
    return read_sheet(text[:end], name) if end > 0 else None


def read_block(text: str, head: Sheet) -> tuple[FloatArray, list[int]] | None:
    """Return the columns that hold numbers, shape (N, C), and which they are; None where a cell is none."""
    if not head.rows:
        return None
    columns = [i for i in range(len(head.header)) if all(is_number(row[i]) for _, row in head.rows)]
    if not columns:
        return None
    try:
        block = np.loadtxt(
            _lines(text, head.rows[0][0]),
            dtype=np.float64,
            delimiter=head.delimiter,
            usecols=columns,
            comments=None,
            ndmin=2,
        )
    except ValueError:
        return None
    return (block, columns) if np.isfinite(block).all() else None


def _lines(text: str, first: int) -> Iterator[str]:
    """Yield the lines from a number on, counted from 1, one at a time."""
    position = 0
    for _ in range(first - 1):
        position = text.index("\n", position) + 1
    while position < len(text):
        end = text.find("\n", position)
        end = len(text) if end < 0 else end
        if end > position:
            yield text[position:end]
        position = end + 1
