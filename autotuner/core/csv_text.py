"""From the bytes of a CSV file to its header and rows, whoever wrote it.

    encoding    UTF-8, UTF-16 with its mark, else the Windows code page 1252
    delimiter   comma, semicolon or tab: the one of which the header holds most
    header      the first line that is no comment (`#`); a line of units under it is left out with a note

Rule of this file: what is no table of text is refused by what it is (a workbook, a page), not by its first odd byte.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

from autotuner.errors import RecordingError

MAX_ROWS = 3_000_000
"""Lines that are read cell by cell at most: more of them would need gigabytes."""
DELIMITERS = (",", ";", "\t")
COMMENT = "#"
UTF_8_MARK = b"\xef\xbb\xbf"
MARKS = ((UTF_8_MARK, "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
SAVE_AS_CSV = "Save the file as CSV in UTF-8."
STRANGERS = (
    (b"PK\x03\x04", "is a workbook or archive, not CSV"),
    (b"\xd0\xcf\x11\xe0", "is a workbook, not CSV"),
    (b"%PDF", "is a PDF, not CSV"),
    (b"\x1f\x8b", "is compressed"),
    (b"\x89HDF", "is HDF5, not CSV"),
    (b"<", "is a page or XML, not CSV"),
    (b"{", "is JSON, not CSV"),
    (b"[{", "is JSON, not CSV"),
)
"""First bytes of what is often given instead of a CSV file."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """The cells of a CSV text.

    Attributes
    ----------
    header : list of str
        Titles; the numbers of the columns from 1 where the text has no header.
    rows : list of (int, list of str)
        Line number and cells of each sample.
    delimiter : str
        What stands between cells.
    notes : tuple of str
        What was left out.
    titled : bool
        Whether the text has a header.
    """

    header: list[str]
    rows: list[tuple[int, list[str]]]
    delimiter: str
    notes: tuple[str, ...]
    titled: bool

    @property
    def decimal_comma(self) -> bool:
        """Whether a comma may stand for the decimal point."""
        return self.delimiter != ","


def decoded(content: bytes, name: str) -> str:
    """Return the text of a file.

    Raises
    ------
    RecordingError
        It is another kind of file, or no text.
    """
    for first, what in STRANGERS:
        if content.removeprefix(UTF_8_MARK).startswith(first):
            raise RecordingError(what, field=name, remedy=SAVE_AS_CSV)
    encoding = next((encoding for mark, encoding in MARKS if content.startswith(mark)), "utf-8")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        if b"\x00" in content or encoding == "utf-16":
            raise RecordingError(f"is not UTF-8 text (byte {error.start})", field=name, remedy=SAVE_AS_CSV) from error
    try:
        # Only titles hold such letters: numbers read the same in every code page.
        return content.decode("cp1252")
    except UnicodeDecodeError as error:
        raise RecordingError(f"is not UTF-8 text (byte {error.start})", field=name, remedy=SAVE_AS_CSV) from error


def read_sheet(text: str, name: str) -> Sheet:
    """Return header and rows of a CSV text.

    Raises
    ------
    RecordingError
        No text, a line shorter than the header, or too many lines.
    """
    if not text.strip():
        raise _empty(name)
    if (count := text.count("\n")) > MAX_ROWS:
        raise RecordingError(
            f"has more than {MAX_ROWS} lines, and not every cell is a plain number",
            field=name,
            value=count,
            remedy="Thin it out or give a part of it, or write plain numbers only.",
        )
    delimiter = _delimiter(text)
    lines = _lines(text, delimiter, name)
    if not lines:  # nothing but separators
        raise _empty(name)
    while len(lines) > 1 and lines[0][1][0].lstrip().startswith(COMMENT):
        lines.pop(0)
    header, rows = [cell.strip() for cell in lines[0][1]], lines[1:]
    titled = not all(is_number(cell) for cell in header)
    if not titled:
        header, rows = [str(i + 1) for i in range(len(header))], lines
    notes = []
    if titled and rows and _tells_units(rows[0][1]):
        notes.append(f"{name}: line {rows[0][0]} holds units and was left out")
        rows = rows[1:]
    _require_whole(header, rows, name)
    return Sheet(header, rows, delimiter, tuple(notes), titled)


def _empty(name: str) -> RecordingError:
    return RecordingError("is empty", field=name, remedy="Give a CSV with the header t,u,y and one line a sample.")


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _lines(text: str, delimiter: str, name: str) -> list[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=None), delimiter=delimiter)
    try:
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise RecordingError(
            f"is no CSV: {error}", field=f"{name}, line {reader.line_num}", remedy=SAVE_AS_CSV
        ) from error


def _delimiter(text: str) -> str:
    lines = (line for line in io.StringIO(text, newline=None) if line.strip() and not line.lstrip().startswith(COMMENT))
    return max(DELIMITERS, key=next(lines, "").count)


def _tells_units(row: list[str]) -> bool:
    """Return whether a line under the header holds words only, and no digit in any of them."""
    return any(cell.strip() for cell in row) and not any(character.isdigit() for cell in row for character in cell)


def _require_whole(header: list[str], rows: list[tuple[int, list[str]]], name: str) -> None:
    for line, row in rows:
        if len(row) < len(header):
            raise RecordingError(
                f"has {len(row)} cells where the header has {len(header)}",
                field=f"{name}, line {line}",
                remedy="Complete the line or remove it.",
            )
